//! Embedded files, so that the binary runs without a network and without a data folder: the household model, the scenes, their activity
//! programs and the statistics of the training split. Each is a `static`: the program would contain a `const` once per use.

use std::fs::File;
use std::io::Write;
use std::os::fd::AsRawFd;
use std::path::PathBuf;

/// The household model, a GGUF file; `models/README.md` is its card.
pub static MODEL: &[u8] = include_bytes!("../models/household.gguf");
/// Expected scores of [`MODEL`], JSON; `roomcast model check --record` wrote them.
pub static MODEL_CHECK: &str = include_str!("../models/household-check.json");
/// The name of [`MODEL`] in messages and tables.
pub const MODEL_NAME: &str = "household (embedded)";
/// Statistics of the training split for the forecast's baselines, JSON.
pub static STATISTICS: &str = include_str!("../models/household-statistics.json");

/// The sentences that follow one another in the training split's programs, for guesses at the next sentence, JSON.
pub static FORMS: &str = include_str!("../models/household-forms.json");

/// A text file in the binary.
#[derive(Debug, Clone, Copy)]
pub struct EmbeddedText {
    /// Its name without folder and ending, as on the command line.
    pub name: &'static str,
    /// Its content.
    pub text: &'static str,
}

/// The scenes of `scenes/`; the first is the default.
pub static SCENES: [EmbeddedText; 7] = [
    EmbeddedText { name: "studio", text: include_str!("../scenes/studio.json") },
    EmbeddedText { name: "apartment-e0", text: include_str!("../scenes/apartment-e0.json") },
    EmbeddedText { name: "apartment-e1", text: include_str!("../scenes/apartment-e1.json") },
    EmbeddedText { name: "apartment-e2", text: include_str!("../scenes/apartment-e2.json") },
    EmbeddedText { name: "flat", text: include_str!("../scenes/flat.json") },
    EmbeddedText { name: "ward", text: include_str!("../scenes/ward.json") },
    EmbeddedText { name: "warehouse", text: include_str!("../scenes/warehouse.json") },
];

/// The activity programs of `scenes/programs/` for homes, in VirtualHome's notation. Every apartment has all their objects.
pub static PROGRAMS: [EmbeddedText; 3] = [
    EmbeddedText {
        name: "p0-breakfast-and-television",
        text: include_str!("../scenes/programs/p0-breakfast-and-television.txt"),
    },
    EmbeddedText { name: "p1-laundry-and-to-bed", text: include_str!("../scenes/programs/p1-laundry-and-to-bed.txt") },
    EmbeddedText { name: "p2-long-evening", text: include_str!("../scenes/programs/p2-long-evening.txt") },
];

/// The programs for the ward, then for the warehouse.
pub static WORK_PROGRAMS: [EmbeddedText; 6] = [
    EmbeddedText { name: "w0-medication-round", text: include_str!("../scenes/programs/w0-medication-round.txt") },
    EmbeddedText {
        name: "w1-cleaning-and-fresh-beds",
        text: include_str!("../scenes/programs/w1-cleaning-and-fresh-beds.txt"),
    },
    EmbeddedText { name: "w2-patients-morning", text: include_str!("../scenes/programs/w2-patients-morning.txt") },
    EmbeddedText {
        name: "g0-receiving-a-delivery",
        text: include_str!("../scenes/programs/g0-receiving-a-delivery.txt"),
    },
    EmbeddedText {
        name: "g1-picking-and-packing",
        text: include_str!("../scenes/programs/g1-picking-and-packing.txt"),
    },
    EmbeddedText { name: "g2-end-of-shift", text: include_str!("../scenes/programs/g2-end-of-shift.txt") },
];

#[must_use]
pub(crate) fn scene_names() -> String {
    SCENES.map(|scene| scene.name).join(", ")
}

#[must_use]
pub(crate) fn program_names() -> String {
    let names: Vec<_> = PROGRAMS.iter().chain(&WORK_PROGRAMS).map(|program| program.name).collect();
    names.join(", ")
}

/// The embedded scene with a name.
#[must_use]
pub fn scene(name: &str) -> Option<EmbeddedText> {
    SCENES.into_iter().find(|scene| scene.name == name)
}

/// The embedded activity program with a name.
#[must_use]
pub fn program(name: &str) -> Option<EmbeddedText> {
    PROGRAMS.into_iter().chain(WORK_PROGRAMS).find(|program| program.name == name)
}

/// The embedded model as an anonymous file in memory, since llama.cpp loads files. It leaves no file behind, is never out of date, and
/// needs no writable folder.
#[derive(Debug)]
pub struct ModelFile {
    file: File,
}

impl ModelFile {
    /// Copies [`MODEL`] into an anonymous file.
    ///
    /// # Errors
    ///
    /// The system's, if memory or file descriptors are exhausted.
    pub fn create() -> std::io::Result<Self> {
        let mut file = File::from(rustix::fs::memfd_create("roomcast-model", rustix::fs::MemfdFlags::CLOEXEC)?);
        file.write_all(MODEL)?;
        Ok(Self { file })
    }

    /// A path that opens the file, in this process and during the life of this value.
    #[must_use]
    pub fn path(&self) -> PathBuf {
        format!("/proc/self/fd/{}", self.file.as_raw_fd()).into()
    }
}

/// Gives the memory of [`MODEL`] back to the system. Only loading reads the model; a later read gets it from the program's file again.
pub fn release_model() {
    // The largest page of any Linux.
    const PAGE_BYTES: usize = 1 << 16;
    let before = MODEL.as_ptr().align_offset(PAGE_BYTES).min(MODEL.len());
    let whole = &MODEL[before..][..(MODEL.len() - before) / PAGE_BYTES * PAGE_BYTES];
    let start = whole.as_ptr().cast_mut().cast();
    #[expect(unsafe_code, reason = "the system call can change memory")]
    // SAFETY: these pages hold a constant of the program's file and were never written. A later read loads them from the file again.
    let _released = unsafe { rustix::mm::madvise(start, whole.len(), rustix::mm::Advice::LinuxDontNeed) };
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_llama::gguf::Header;
    use sha2::{Digest, Sha256};

    #[test]
    fn the_embedded_model_is_a_sound_language_model_of_at_most_7_mebibytes() {
        let file = ModelFile::create().unwrap();
        let header = Header::read_language_model(&file.path()).unwrap();
        assert_eq!(header.architecture(), Some("llama"));
        assert_eq!(header.size_bytes, MODEL.len() as u64);
        assert!(MODEL.len() <= 7 << 20);
        let digest = Sha256::digest(MODEL);
        release_model();
        assert_eq!(Sha256::digest(MODEL), digest, "a released model is read again");
    }

    #[test]
    fn scenes_and_programs_are_found_by_name() {
        assert!(scene("studio").unwrap().text.contains("roomcast-scene"));
        for program in PROGRAMS.into_iter().chain(WORK_PROGRAMS) {
            assert!(super::program(program.name).unwrap().text.contains("[Walk]"));
        }
        assert!(scene("castle").is_none());
    }
}
