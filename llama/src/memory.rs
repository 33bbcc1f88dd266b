//! Memory that loading has freed.

/// Returns freed memory to the system: the C library keeps it, and a service needs far more to load than to run.
pub fn return_freed() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        #[expect(unsafe_code, reason = "no package has a safe function for it")]
        // SAFETY: the signature is glibc's. The function takes any number, and each thread may call it at any time.
        unsafe extern "C" {
            safe fn malloc_trim(pad: usize) -> std::ffi::c_int;
        }
        malloc_trim(0);
    }
}
