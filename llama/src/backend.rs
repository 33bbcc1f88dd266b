//! llama.cpp's state of the whole process: its log, its kernels, and its compiled features.

use std::sync::{Mutex, OnceLock};

use llama_cpp_2::llama_backend::LlamaBackend;
use llama_cpp_2::{LogOptions, send_logs_to_tracing};
use roomcast_core::scorer::ModelError;

/// Sets up llama.cpp's process-wide state once; its log goes to `tracing`. This is public for programs that also run llama.cpp directly, to
/// compare: a second set-up fails.
///
/// # Errors
/// Why it cannot be set up.
pub fn backend() -> Result<&'static LlamaBackend, String> {
    static BACKEND: OnceLock<LlamaBackend> = OnceLock::new();
    static SETTING_UP: Mutex<()> = Mutex::new(());
    let _guard = SETTING_UP.lock().map_err(|_| "setting up llama.cpp failed before".to_owned())?;
    if let Some(backend) = BACKEND.get() {
        return Ok(backend);
    }
    send_logs_to_tracing(LogOptions::default().with_logs_enabled(true));
    #[cfg(feature = "portable")]
    load_kernels()?;
    let backend = LlamaBackend::init().map_err(|e| e.to_string())?;
    Ok(BACKEND.get_or_init(|| backend))
}

/// Loads the best kernels for this processor from `../lib/roomcast` beside the program. It never uses the folder of the build: on a user's
/// machine, another user could create that folder.
#[cfg(feature = "portable")]
fn load_kernels() -> Result<(), String> {
    use llama_cpp_2::llama_backend::load_backends_from_path;
    let program = std::env::current_exe().map_err(|e| format!("the program's own path cannot be found: {e}"))?;
    let folder = &program.ancestors().nth(2).unwrap_or(&program).join("lib/roomcast");
    let mut entries = folder.read_dir().into_iter().flatten().flatten();
    if folder.to_str().is_none()
        || !entries.any(|entry| entry.file_name().to_string_lossy().starts_with("libggml-cpu-"))
    {
        return Err(format!("no kernels (libggml-cpu-*.so) in {}: install the package again", folder.display()));
    }
    load_backends_from_path(folder);
    Ok(())
}

/// The vector units and options that llama.cpp was compiled with, as ggml names them (`AVX2`, `FMA`, `NEON`, ...).
///
/// # Errors
/// When llama.cpp cannot be set up.
pub fn build_features() -> Result<Vec<String>, ModelError> {
    static ASKING: Mutex<()> = Mutex::new(());
    let fail = |reason: String| ModelError::Load { path: "(llama.cpp)".into(), reason };
    backend().map_err(fail)?;
    let guard = ASKING.lock().map_err(|_| fail("asking for its features failed before".into()))?;
    #[expect(unsafe_code, reason = "llama-cpp-2 has no safe function for it")]
    // SAFETY: the function returns a zero-terminated text in a static that the next call rewrites. The lock keeps other calls away until it
    // is copied, and the backend is set up.
    let text =
        unsafe { std::ffi::CStr::from_ptr(llama_cpp_sys_2::llama_print_system_info()) }.to_string_lossy().into_owned();
    drop(guard);
    // "CPU : SSE3 = 1 | AVX2 = 1 | "
    let entries = text.split(['|', ':']).filter_map(|entry| entry.trim().split_once(" = "));
    Ok(entries.filter(|&(_, value)| value.trim() != "0").map(|(name, _)| name.to_owned()).collect())
}
