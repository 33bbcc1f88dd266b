//! The activities of a study: programs and days, with unique names.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::StudyArgs;
use crate::commands::{Manifest, prediction};
use roomcast_cli::{CommandResult, Failure};
use roomcast_services::setup;
use roomcast_simulation::homer::Day;
use roomcast_simulation::study::Activity;

pub(super) struct Named {
    /// The file; for a shipped program its name.
    pub(super) path: PathBuf,
    /// The name in results. Names are unique, since results of one name would be merged.
    pub(super) name: String,
    /// The seed of its draws. It does not depend on the folder, so that files can be moved.
    pub(super) drawn_by: String,
    pub(super) activity: Activity,
}

fn last_parts(path: &Path, count: usize) -> String {
    let parts: Vec<_> = path.components().collect();
    parts[parts.len().saturating_sub(count)..].iter().collect::<PathBuf>().display().to_string()
}

/// Extends equal names by as much of the paths as makes them different.
pub(super) fn tell_apart(activities: &mut [Named]) -> CommandResult {
    for parts in 2.. {
        let mut called = HashMap::<&str, usize>::new();
        activities.iter().for_each(|own| *called.entry(&own.name).or_default() += 1);
        let alike: Vec<usize> = (0..activities.len()).filter(|own| called[&*activities[*own].name] > 1).collect();
        let Some(first) = alike.first() else { break };
        if alike.iter().all(|own| activities[*own].path.components().count() < parts) && parts > 2 {
            let text = format!("--program has {} twice: give it once", activities[*first].path.display());
            return Err(Failure::usage(text));
        }
        for own in alike {
            activities[own].name = last_parts(&activities[own].path, parts);
        }
    }
    Ok(())
}

impl StudyArgs {
    pub(super) fn load(&self, path: &Path) -> Result<Vec<Named>, Failure> {
        if let Some(shipped) = setup::shipped_program(path) {
            let name = path.display().to_string();
            let activity = Activity::Program(shipped?);
            return Ok(vec![Named { path: path.to_owned(), name: name.clone(), drawn_by: name, activity }]);
        }
        let mut files = prediction::load_programs(path)?;
        if let Some(manifest) = self.manifest.as_ref().filter(|_| path.is_dir()) {
            files = Manifest::read(manifest)?.split(files, &self.split)?;
        }
        let mut activities = Vec::with_capacity(files.len());
        let stem = |file: &Path| file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut names = HashMap::<String, usize>::new();
        files.iter().for_each(|file| *names.entry(stem(&file.path)).or_default() += 1);
        for file in files {
            let mut name = stem(&file.path);
            // The folders distinguish files of the same name.
            if names[&name] > 1 {
                let below = file.path.strip_prefix(path).unwrap_or(&file.path);
                name = below.with_extension("").display().to_string();
            }
            // Programs were read already; days are read again with their times.
            let day = std::fs::read_to_string(&file.path).ok().filter(|text| Day::recognise(text));
            let activity = match day {
                Some(text) => Activity::Day(Day::parse(&text)?),
                None => Activity::Program(file.program),
            };
            activities.push(Named { path: file.path, name: name.clone(), drawn_by: name, activity });
        }
        Ok(activities)
    }
}
