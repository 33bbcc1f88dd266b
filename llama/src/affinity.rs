//! Binds the scorer to processor cores.

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// The cores cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AffinityError {
    /// The process may not run on a core.
    #[error("model.cores names core {core}, but this process may run on {allowed:?} only: name some of these, or none")]
    Unknown {
        /// The core.
        core: usize,
        /// The cores that it may run on.
        allowed: Vec<usize>,
    },
    /// The system refused.
    #[error("the scorer cannot be bound to the cores {cores:?} (model.cores): {source}")]
    Refused {
        /// The cores.
        cores: Vec<usize>,
        /// The system's error.
        source: std::io::Error,
    },
}

/// Binds the calling thread, and every thread that it starts from now on, to `cores`. Does nothing if `cores` is empty.
///
/// The thread that decodes first starts llama.cpp's threads, so binding that one binds them all.
///
/// # Errors
///
/// [`AffinityError`] if a core does not exist or this process may not run on it.
pub fn bind(cores: &[usize]) -> Result<(), AffinityError> {
    if cores.is_empty() {
        return Ok(());
    }
    let refused = |source: rustix::io::Errno| AffinityError::Refused { cores: cores.to_vec(), source: source.into() };
    sched_setaffinity(None, &chosen(cores)?).map_err(refused)
}

/// Whether this process may run on `cores`, without binding anything.
///
/// # Errors
///
/// As [`bind`].
pub fn check(cores: &[usize]) -> Result<(), AffinityError> {
    chosen(cores).map(|_| ())
}

fn chosen(cores: &[usize]) -> Result<CpuSet, AffinityError> {
    let refused = |source: rustix::io::Errno| AffinityError::Refused { cores: cores.to_vec(), source: source.into() };
    let allowed = sched_getaffinity(None).map_err(refused)?;
    let mut chosen = CpuSet::new();
    for &core in cores {
        if core >= CpuSet::MAX_CPU || !allowed.is_set(core) {
            let allowed = (0..CpuSet::MAX_CPU).filter(|&core| allowed.is_set(core)).collect();
            return Err(AffinityError::Unknown { core, allowed });
        }
        chosen.set(core);
    }
    Ok(chosen)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_and_its_children_stay_on_the_cores_named() {
        std::thread::spawn(|| {
            bind(&[]).unwrap();
            let before = sched_getaffinity(None).unwrap();
            let core = (0..CpuSet::MAX_CPU).find(|&core| before.is_set(core)).unwrap();
            bind(&[core]).unwrap();
            let child = std::thread::spawn(|| sched_getaffinity(None).unwrap()).join().unwrap();
            assert!(child.count() == 1 && child.is_set(core));
            let error = bind(&[core, CpuSet::MAX_CPU]).unwrap_err().to_string();
            assert!(error.contains("model.cores") && error.contains(&format!("[{core}]")), "{error}");
        })
        .join()
        .unwrap();
    }
}
