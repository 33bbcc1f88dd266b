//! Checks of a home's set-up: map, rules, persons, broker, topics, robot, and running services.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::{Duration, SystemTime};

use roomcast_core::grounding::Grounding;
use roomcast_core::narration::same_but_for_accents;
use roomcast_core::semantic_map::{PartitionId, SemanticMap};
use roomcast_ipc::{Domain, sequence};
use roomcast_services::config::{Config, NoFolder, no_folder};
use roomcast_services::daemon::{NoZone, Zone};
use roomcast_services::logging::chain;
use roomcast_services::participant::{DRIVER, OfRobot, PLANNER};

use super::finding::{Finding, Place, rules_of_no_room, segment_of_no_room, segments_at_odds, some_of};
#[cfg(feature = "whole")]
use super::home_mqtt;
use crate::cli::{count, service};

const STATUS_MAX: Duration = Duration::from_secs(2);
/// Seconds that the clock may be behind a file's time.
const CLOCK_S: u64 = 3600;

pub(super) fn checks(
    config: &Config,
    map: Option<(&SemanticMap, &Grounding)>,
    domain: &Domain,
    place: &Place<'_>,
) -> Vec<Finding> {
    let mut findings = vec![clock(config, place)];
    findings.extend(state(config, place));
    findings.extend(damaged(config));
    if let Some((map, grounding)) = map {
        findings.push(things(config, map, grounding, place));
        findings.extend(rules_of_no_room(config, map, grounding, &place.shown()));
    }
    #[cfg(feature = "whole")]
    findings.extend(home_mqtt::checks(config, map, place));
    findings.push(persons(config, place));
    findings.extend(services(config, map.map(|(map, _)| map), domain, place));
    findings
}

/// Checks the names in a configuration file and its rules, without a look at running services.
pub(super) fn names(config: &Config, home: Option<(&SemanticMap, &Grounding)>, place: &Place<'_>) -> Vec<Finding> {
    let shown = place.shown();
    let segment = |(map, _): (&SemanticMap, &Grounding)| {
        segment_of_no_room(config, map, &shown).or_else(|| segments_at_odds(config, map, &shown))
    };
    let segment = home.and_then(segment).map(|(found, remedy)| Finding::wrong("robot", found, remedy));
    let mut findings: Vec<Finding> = segment.into_iter().collect();
    findings.extend(home.into_iter().flat_map(|(map, grounding)| rules_of_no_room(config, map, grounding, &shown)));
    #[cfg(feature = "whole")]
    if let Some(path) = config.mqtt.rules.as_deref() {
        findings.extend(home_mqtt::rules(path, home).0);
    }
    findings.push(persons(config, place));
    findings
}

/// Checks the clock: habits depend on the time of day.
fn clock(config: &Config, place: &Place<'_>) -> Finding {
    let check = "clock";
    let written = |path: &Path| std::fs::metadata(path).and_then(|about| about.modified()).ok();
    let files = [Some(place.config), config.scene.path.as_deref(), config.mqtt.rules.as_deref()];
    let newest = files.into_iter().flatten().filter_map(|path| Some((written(path)?, path))).max();
    let ahead = newest.and_then(|(at, path)| Some((at.duration_since(SystemTime::now()).ok()?.as_secs(), path)));
    if let Some((seconds, path)) = ahead.filter(|(seconds, _)| *seconds > CLOCK_S) {
        let found =
            format!("the clock is {seconds} s before {} was written, and habits go by the time of day", path.display());
        return Finding::wrong(check, found, "set the clock: timedatectl set-ntp true");
    }
    match Zone::find() {
        Ok(_) => Finding::good(check, "plausible, and a time zone is set"),
        Err(NoZone { reason, remedy }) => {
            Finding::limited(check, format!("{reason}, so hours of the day are those of UTC"), remedy)
        }
    }
}

fn state(config: &Config, place: &Place<'_>) -> Option<Finding> {
    let check = "state";
    let folder = config.daemon.state_directory()?;
    let shown = folder.display();
    let another = || format!("give another folder as daemon.state in {}", place.shown());
    // The daemon makes a missing folder.
    let finding = match no_folder(&folder) {
        None => match little_room(&folder) {
            None => Finding::good(check, format!("kept in {shown}")),
            Some(left) => {
                let found = format!("kept in {shown}, on whose disk {left} KiB are left");
                let remedy = format!("make room on it; or {}", another());
                if left == 0 { Finding::wrong(check, found, remedy) } else { Finding::limited(check, found, remedy) }
            }
        },
        Some(NoFolder { reason, remedy }) => {
            let remedy = remedy.map_or_else(another, str::to_owned);
            Finding::wrong(check, format!("nothing can be kept in {shown}: {reason}"), remedy)
        }
    };
    Some(finding)
}

/// Names the databases that were set aside because they were damaged.
fn damaged(config: &Config) -> Option<Finding> {
    let folder = config.daemon.state_directory()?;
    let names = std::fs::read_dir(&folder).ok()?.filter_map(|file| file.ok()?.file_name().into_string().ok());
    let is_log = |name: &String| name.ends_with("-wal") || name.ends_with("-shm");
    let mut damaged: Vec<_> = names.filter(|name| name.contains(".db.damaged-") && !is_log(name)).collect();
    damaged.sort_unstable();
    let found =
        format!("{} in {}, set aside because of damage", some_of(damaged.iter().map(String::as_str)), folder.display());
    let remedy = "the log says what was lost; check the disk, then remove these files";
    (!damaged.is_empty()).then(|| Finding::limited("state", found, remedy))
}

/// The free KiB on a folder's disk (or its nearest existing parent's), if they may not suffice for the daemon's state.
fn little_room(folder: &Path) -> Option<u64> {
    /// Journal, habits, and another copy of each while it is replaced.
    const ENOUGH_BYTES: u64 = 64 << 20;
    let disk = folder.ancestors().find_map(|folder| rustix::fs::statvfs(folder).ok())?;
    let left_bytes = disk.f_bavail.saturating_mul(disk.f_frsize);
    (left_bytes < ENOUGH_BYTES).then_some(left_bytes >> 10)
}

/// Checks whether the rooms contain things that persons use.
fn things(config: &Config, map: &SemanticMap, grounding: &Grounding, place: &Place<'_>) -> Finding {
    let check = "things";
    let file = config.scene.path.as_ref().map(|path| path.display().to_string());
    let Some(file) = file else {
        let found = format!("{} names no map, so the included studio stands for this home", place.shown());
        return Finding::limited(check, found, "roomcast init makes a map of your home; or set scene.path");
    };
    let remedy = "import it again with --furnish typical, or add items (scenes/README.md)";
    let bare: Vec<&str> = (0u32..)
        .zip(grounding.partitions())
        .filter(|(index, _)| !grounding.item_partition().contains(&Some(PartitionId(*index))))
        .map(|(_, partition)| partition.id.as_str())
        .collect();
    match (map.items().len(), bare.len()) {
        (0, _) => Finding::wrong(
            check,
            format!("{file}: nothing stands in any room, so nothing tells the rooms apart"),
            remedy,
        ),
        (_, 0) => Finding::good(check, format!("{file}: every room has things")),
        (_, bare_rooms) => {
            let found = format!("{file}: {} without things: {}", count(bare_rooms, "room"), some_of(bare));
            Finding::limited(check, found, remedy)
        }
    }
}

/// Compares the home's persons with those of the rules.
fn persons(config: &Config, place: &Place<'_>) -> Finding {
    let check = "persons";
    let residents = &config.persons.residents;
    #[cfg(feature = "whole")]
    let named = home_mqtt::persons_of_rules(config);
    #[cfg(not(feature = "whole"))]
    let named: Vec<String> = Vec::new();
    let is_resident = |name: &str| residents.iter().any(|resident| same_but_for_accents(resident, name));
    let visitors: Vec<&str> = named.iter().map(String::as_str).filter(|name| !is_resident(name)).collect();
    let shown = place.shown();
    if let [odd, ..] = &config.persons.odd_names(named.iter().map(String::as_str))[..] {
        return Finding::limited(
            check,
            odd.clone(),
            format!("correct it in persons.residents of {shown}, or in the rules"),
        );
    }
    match (residents.is_empty(), named.is_empty()) {
        (true, true) => Finding::good(check, format!("{shown} names nobody: whoever is observed lives here")),
        (true, false) => Finding::good(
            check,
            format!("the rules name {}; nobody counts as a visitor", some_of(named.iter().map(String::as_str))),
        ),
        (false, _) if !visitors.is_empty() => Finding::limited(
            check,
            format!("the rules name {}: not among persons.residents in {shown}, so a visitor", some_of(visitors)),
            "add who lives here to persons.residents, or correct the name in the rules",
        ),
        (false, _) => Finding::good(check, format!("{} in {shown}", count(residents.len(), "resident"))),
    }
}

fn services(config: &Config, map: Option<&SemanticMap>, domain: &Domain, place: &Place<'_>) -> Vec<Finding> {
    let check = "services";
    let file = place.shown();
    let node = match domain.open("roomcast-doctor") {
        Ok(node) => node,
        Err(error) => {
            let remedy = "run this as the user that the services run as, with their ipc.root and ipc.domain";
            return vec![Finding::wrong(check, chain(&error), remedy)];
        }
    };
    let alive: BTreeSet<String> = match node.participants() {
        Ok(alive) => alive.into_iter().collect(),
        Err(error) => return vec![Finding::wrong(check, chain(&error), "try again; roomcast top shows what runs")],
    };
    let runs = |name: &str| alive.iter().any(|other| other.starts_with(name));
    let robot = sequence::source_of_name(&config.planner.robot);
    let serves = |kind: OfRobot| alive.iter().any(|other| kind.robot_of(other) == Some(robot));
    let has_robot = config.robot != Default::default();
    let narrates = config.mqtt.rules.is_some();
    let bridges = config.mqtt.broker.is_some();
    let all = [
        ("daemon", true, runs("roomcast-daemon"), "daemon"),
        ("narrator", narrates, runs("roomcast-narrator-"), "narrate --mqtt"),
        ("planner", has_robot, serves(PLANNER), "planner"),
        ("robot", has_robot, serves(DRIVER), "robot"),
        ("bridge", bridges, runs("roomcast-publish"), "publish mqtt"),
    ];
    let missing: Vec<_> = all.iter().filter(|(_, wanted, runs, _)| *wanted && !runs).collect();
    let running: Vec<&str> = all.iter().filter(|(_, _, runs, _)| *runs).map(|(name, ..)| *name).collect();
    if running.is_empty() {
        let names = some_of(missing.iter().map(|(name, ..)| *name));
        let first =
            format!("start them, each in a terminal of its own or as a unit; first: roomcast daemon --config {file}");
        return vec![Finding::limited(check, format!("nothing runs yet: {names}"), first)];
    }
    let mut findings = vec![Finding::good(check, format!("running: {}", some_of(running.iter().copied())))];
    for (name, _, _, command) in missing {
        // Without the daemon there is no forecast, and without its planner a robot does nothing, as does a home without narration.
        let found = format!("{} runs, and no {name} does, in {}", running[0], service::shown(domain));
        let start = format!("roomcast {command} --config {file}");
        findings.push(match *name {
            "robot" => Finding::limited("robot service", found, start),
            "bridge" => Finding::limited(name, found, start),
            _ => Finding::wrong(name, found, start),
        });
    }
    if running.contains(&"daemon") {
        findings.push(daemon(map, &node, &file));
    }
    findings
}

/// A fast clock of a narrator, as the daemon has measured it.
fn fast_clock(ahead: u64, ahead_ns: u64) -> Option<Finding> {
    let found = format!(
        "the clock of a narrator's input is {:.0} s fast: {} were taken as observed when they came",
        ahead_ns as f64 / 1e9,
        count(ahead as usize, "narration")
    );
    let remedy = "set the clock of the camera or machine that dates them (NTP); the daemon's log names the narrator";
    (ahead > 0).then(|| Finding::limited("daemon", found, remedy))
}

fn daemon(map: Option<&SemanticMap>, node: &roomcast_ipc::Node, file: &str) -> Finding {
    let check = "daemon";
    let status = match node.status_client().and_then(|client| client.ask(STATUS_MAX)) {
        Ok(status) => status,
        Err(error) => return Finding::wrong(check, chain(&error), "see the daemon's log; start it again"),
    };
    if map.is_some_and(|map| map.fingerprint() != status.map_fingerprint) {
        let found = format!("the daemon uses another map ({}) than {file} names", status.map());
        let remedy = "start the daemon again, unless the map was changed while it runs (scene apply)";
        return Finding::limited(check, found, remedy);
    }
    if status.version() != env!("CARGO_PKG_VERSION") {
        let found = format!("the daemon is version {}, this is {}", status.version(), env!("CARGO_PKG_VERSION"));
        return Finding::wrong(check, found, "start it again with this version");
    }
    if status.failed_steps > 0 {
        let found = format!("{} of {} steps failed", status.failed_steps, status.steps);
        return Finding::wrong(check, found, "its log says why; roomcast model check");
    }
    if status.journal_failures > 0 {
        let found =
            format!("its state database had {} since it started", count(status.journal_failures as usize, "fault"));
        let remedy = "its log says why; after failed writes a restart knows less of who is where";
        return Finding::limited(check, found, remedy);
    }
    if let Some(finding) = fast_clock(status.ahead, status.ahead_ns) {
        return finding;
    }
    let found = format!(
        "{} accepted, {}",
        count(status.accepted as usize, "narration"),
        count(status.persons as usize, "person")
    );
    match status.accepted {
        0 => Finding::limited(
            check,
            "nothing was narrated since it started",
            "do something that a sensor sees, or look at the narrator's log",
        ),
        _ => Finding::good(check, found),
    }
}

#[cfg(test)]
mod tests {
    use super::super::finding::Verdict;
    use super::*;

    #[test]
    fn a_database_that_was_set_aside_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let mut config = Config::default();
        config.daemon.state = Some(folder.path().to_owned());
        assert!(damaged(&config).is_none());
        let state = config.daemon.state_directory().unwrap();
        std::fs::create_dir_all(&state).unwrap();
        for name in ["roomcast.db", "roomcast.db.damaged-1", "roomcast.db.damaged-1-wal", "planner-7.db.damaged-1"] {
            std::fs::write(state.join(name), "").unwrap();
        }
        let found = damaged(&config).unwrap().found;
        assert!(found.starts_with("planner-7.db.damaged-1, roomcast.db.damaged-1 in "), "{found}");
    }

    #[test]
    fn a_fast_clock_of_a_narrator_is_found_with_its_offset() {
        assert!(fast_clock(0, 0).is_none());
        let finding = fast_clock(12, 2_000_000_000).unwrap();
        assert_eq!(finding.verdict, Verdict::Limited);
        assert!(finding.found.contains("is 2 s fast: 12 narrations"), "{}", finding.found);
    }
}
