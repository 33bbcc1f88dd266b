//! Checks of a home's broker: whether it can be reached, which topics it has, and whether rules and robot match them.

use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use roomcast_core::grounding::Grounding;
use roomcast_core::places::PlaceMatcher;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::text::nearest;
use roomcast_services::config::{Config, RobotKind};
use roomcast_services::logging::chain;
use roomcast_services::mqtt::look::{self, Seen};
use roomcast_services::mqtt::tally::Counted;
use roomcast_services::mqtt::{self, Broker, MqttError, Rules};
use roomcast_services::vacuum::{Dialect, Sensed, Status, by_ids, segment_of};

use super::finding::{Finding, Place, room_remedy, segment_of_no_room, some_of};
use super::remarks::missing_thing;
use crate::cli::count;

/// Home Assistant's domains with states about people.
const OF_PEOPLE: [&str; 8] = ["binary_sensor", "light", "switch", "media_player", "lock", "cover", "fan", "person"];

/// Home Assistant's states under another base topic than the rules'.
const STATES: [&str; 4] = ["+/binary_sensor/+/state", "+/light/+/state", "+/switch/+/state", "+/person/+/state"];
/// Rules are counted for this many hours before an unused one is reported: not every door is opened within minutes.
const COUNTED_H_MIN: f64 = 1.0;
/// Robots under another prefix than the configured one.
const ROBOTS: [&str; 2] = ["+/+/$state", "+/+/StatusStateAttribute/status"];

pub(super) fn checks(config: &Config, home: Option<(&SemanticMap, &Grounding)>, place: &Place<'_>) -> Vec<Finding> {
    let mut findings = Vec::new();
    let rules = match config.mqtt.rules.as_deref() {
        None if config.mqtt.broker.is_some() => {
            let found =
                format!("{} names a broker and no rules, so nothing is narrated of its messages", place.shown());
            let remedy = "set mqtt.rules; roomcast init writes rules from Home Assistant";
            findings.push(Finding::limited("rules", found, remedy));
            None
        }
        None => None,
        Some(path) => {
            let (found, rules) = rules(path, home);
            findings.extend(found);
            rules
        }
    };
    let Some(address) = config.mqtt.broker.clone() else {
        if rules.is_some() || has_robot(config) {
            let found = format!("{} names rules or a robot, and no broker", place.shown());
            findings.push(Finding::wrong("broker", found, "set broker = \"mqtt://127.0.0.1\" in the section [mqtt]"));
        }
        return findings;
    };
    let broker = Broker {
        address,
        client: format!("roomcast-doctor-{}", std::process::id()),
        credentials: config.mqtt.credentials.clone(),
        authority: config.mqtt.ca.clone(),
    };
    let seen = match look::look(&broker, &filters(config, rules.as_ref()), place.wait, |_| false) {
        Ok(seen) => {
            findings.push(reached(&broker, &seen));
            seen
        }
        Err(error) => {
            let remedy = format!("{} ({})", error.remedy(), place.shown());
            findings.push(Finding::wrong("broker", chain(&error), remedy));
            return findings;
        }
    };
    if let (Some(rules), Some(path)) = (&rules, config.mqtt.rules.as_deref()) {
        findings.extend(topics(rules, path, &seen, config, place));
    }
    if has_robot(config) {
        findings.extend(robot(config, home.map(|(map, _)| map), &seen, place));
    }
    findings
}

fn has_robot(config: &Config) -> bool {
    config.robot != Default::default()
}

/// Names of persons in the rules, without placeholders.
pub(super) fn persons_of_rules(config: &Config) -> Vec<String> {
    let rules = config.mqtt.rules.as_deref().and_then(|path| Rules::load(path).ok());
    let mut names: Vec<String> =
        rules.iter().flat_map(Rules::about).filter_map(|rule| rule.person).filter(|name| !name.contains('{')).collect();
    names.sort();
    names.dedup();
    names
}

/// Checks whether the rules can be read and name existing rooms and things.
pub(super) fn rules(path: &Path, home: Option<(&SemanticMap, &Grounding)>) -> (Vec<Finding>, Option<Rules>) {
    let check = "rules";
    let rules = match Rules::load(path) {
        Ok(rules) => rules,
        Err(error) => {
            let remedy = match &error {
                MqttError::Read { .. } => {
                    "correct mqtt.rules in the configuration, or write rules there (docs/mqtt.md)"
                }
                _ => "correct the line that it names; docs/mqtt.md shows every key",
            };
            return (vec![Finding::wrong(check, chain(&error), remedy)], None);
        }
    };
    let rooms = home.and_then(|(map, _)| rooms_of_rules(path, &rules, map));
    let good = || Finding::good(check, format!("{}: {}", path.display(), count(rules.about().count(), "rule")));
    let mut findings = vec![rooms.unwrap_or_else(good)];
    findings.extend(home.and_then(|(map, grounding)| things_of_rules(path, &rules, map, grounding)));
    (findings, Some(rules))
}

fn rooms_of_rules(path: &Path, rules: &Rules, map: &SemanticMap) -> Option<Finding> {
    let named = rules.about().flat_map(|rule| {
        let rooms = [rule.room, rule.beyond].into_iter().flatten();
        rooms.map(move |room| (rule.number, room))
    });
    let unknown: Vec<_> = named.filter(|(_, room)| !room.contains('{') && map.find_one_room(room).is_none()).collect();
    let (number, room) = unknown.first()?;
    let why = match map.find_room(room) {
        Some(_) => "as several of the map are called",
        None => "which the map does not have",
    };
    let more = match unknown.len() {
        1 => String::new(),
        2 => ", and one more rule does alike".to_owned(),
        several => format!(", and {} more rules do alike", several - 1),
    };
    let found = format!("{}: rule {number} names the room {room:?}, {why}{more}", path.display());
    Some(Finding::wrong("rules", found, room_remedy(room, map)))
}

/// Rules with a sentence about a thing or a room that the map does not have.
fn things_of_rules(path: &Path, rules: &Rules, map: &SemanticMap, grounding: &Grounding) -> Option<Finding> {
    let mut mentions = PlaceMatcher::new(map, grounding);
    let said = rules.about().filter_map(|rule| Some((rule.number, rule.sentence?)));
    let missing: Vec<(usize, String, String)> = said
        .filter_map(|(number, said)| {
            let thing = missing_thing(&said, map, &mut mentions)?;
            Some((number, said, thing))
        })
        .collect();
    let (number, said, thing) = missing.first()?;
    let others: Vec<String> = missing.iter().skip(1).map(|(number, ..)| number.to_string()).collect();
    let more = match others.len() {
        0 => String::new(),
        1 => format!("; the same holds for rule {}", others[0]),
        _ => format!("; the same holds for rules {}", some_of(others.iter().map(String::as_str))),
    };
    let found = format!("{}: rule {number} says {said:?}, and the map has no {thing:?}{more}", path.display());
    let remedy = match nearest(thing, map.labels().iter().map(String::as_str)) {
        Some(meant) => format!("write {meant:?}, which the map has"),
        None => {
            "add the thing to the map (scenes/README.md), or say it by a name that the map has (roomcast scene show)"
                .to_owned()
        }
    };
    Some(Finding::limited("things of rules", found, remedy))
}

/// Whether a topic is Home Assistant's own: `BASE/DOMAIN/OBJECT/state`, or below the base in its manual.
fn is_of_statestream(topic: &str) -> bool {
    topic.starts_with("homeassistant/") || topic.ends_with("/state") && topic.matches('/').count() >= 3
}

fn base(topic: &str) -> String {
    topic.split('/').next().unwrap_or_default().to_owned()
}

/// The subscriptions: wide ones around the rules' topics, and robots.
fn filters(config: &Config, rules: Option<&Rules>) -> Vec<String> {
    let mut roots: Vec<String> = rules.iter().flat_map(|rules| rules.filters()).map(|filter| base(&filter)).collect();
    if has_robot(config) {
        roots.push(base(&config.robot.topic));
        roots.extend(config.robot.battery.as_deref().map(base));
    }
    roots.sort();
    roots.dedup();
    let wide = |root: &String| if root == "#" { root.clone() } else { format!("{root}/#") };
    let mut filters: Vec<String> = roots.iter().map(wide).collect();
    if rules.is_some() {
        filters.extend(STATES.map(str::to_owned));
    }
    // Topics of one level, which the wide filters miss.
    filters.extend(roots.iter().filter(|root| !root.contains(['#', '+'])).cloned());
    if has_robot(config) {
        filters.extend(ROBOTS.map(str::to_owned));
    }
    filters
}

fn reached(broker: &Broker, seen: &Seen) -> Finding {
    let check = "broker";
    // Subscriptions that only search elsewhere may be refused.
    let is_needed = |filter: &str| !STATES.contains(&filter) && !ROBOTS.contains(&filter);
    if let Some((filter, reason)) = seen.refused.iter().find(|(filter, _)| is_needed(filter)) {
        let found = format!("{} refuses the subscription to {filter} ({reason})", broker.address);
        return Finding::wrong(check, found, "give this user the right to read it, in the broker's access list");
    }
    let open = broker
        .credentials
        .as_deref()
        .filter(|path| std::fs::metadata(path).is_ok_and(|about| about.permissions().mode() & 0o007 != 0));
    if let Some(path) = open {
        let found = format!(
            "{} is reached, and everybody on this machine can read its password in {}",
            broker.address,
            path.display()
        );
        return Finding::limited(check, found, format!("chmod 600 {}", path.display()));
    }
    let login = if broker.credentials.is_some() { ", with a password" } else { "" };
    Finding::good(check, format!("{} is reached{login}", broker.address))
}

fn topics(rules: &Rules, path: &Path, seen: &Seen, config: &Config, place: &Place<'_>) -> Vec<Finding> {
    let shown = path.display();
    let own = |topic: &str| {
        topic.starts_with(&format!("{}/", config.bridge.topic))
            || topic.ends_with("/config")
            || topic.contains("roomcast")
    };
    let bases: Vec<String> = rules.filters().iter().map(|filter| base(filter)).collect();
    let is_listened_to = |topic: &str| bases.iter().any(|own| *own == base(topic) || own == "+" || own == "#");
    let all_topics = || seen.topics.iter().filter(|(topic, _)| !own(topic));
    let topics: Vec<(&str, &[u8])> = all_topics()
        .map(|(topic, said)| (topic.as_str(), said.payload.as_slice()))
        .filter(|(topic, _)| is_listened_to(topic))
        .collect();
    let state = config.daemon.state_directory();
    let counted = state.and_then(|folder| Counted::of(&folder, &config.narrator.name));
    let fitted = counted.as_ref().map(|counted| counted.fitted(&rules.keys())).unwrap_or_default();
    let has_fitted = |number: usize| fitted.get(number - 1).copied().flatten().unwrap_or_default() > 0;
    let is_fitted = |topic: &str| rules.about().any(|rule| rules.fits(rule.number, topic));
    let silent: Vec<_> = (rules.about())
        .filter(|rule| !has_fitted(rule.number) && !topics.iter().any(|(topic, _)| rules.fits(rule.number, topic)))
        .collect();
    let all = rules.about().count();
    let wait_s = place.wait.as_secs_f64();
    let mut findings = Vec::new();
    // A nearly equal name is a typo. Other missing topics may just not have had a message yet.
    let misspelt = silent.iter().find_map(|rule| {
        if rule.topic.contains(['+', '#']) {
            return None;
        }
        let unread = topics.iter().map(|(topic, _)| *topic).filter(|topic| !is_fitted(topic));
        Some((rule, nearest(rule.topic, unread)?))
    });
    if let Some((rule, meant)) = misspelt {
        let found = format!(
            "{shown}: rule {} listens to {}, where nothing is said, and {meant} is there",
            rule.number, rule.topic
        );
        findings.push(Finding::wrong("topics", found, format!("write topic = {meant:?}")));
    } else if silent.len() == all {
        let found =
            format!("{shown}: nothing was said within {wait_s:.0} s under any topic of its {}", count(all, "rule"));
        let (found, remedy) = all_silent(rules, &bases, found, all_topics().map(|(topic, _)| topic.as_str()));
        findings.push(Finding::wrong("topics", found, remedy));
    } else if !silent.is_empty() {
        let mut silent_topics: Vec<&str> = silent.iter().map(|rule| rule.topic).collect();
        silent_topics.dedup();
        let names = some_of(silent_topics);
        let found = format!("{shown}: of {}, {} heard nothing yet: {names}", count(all, "rule"), silent.len());
        let remedy =
            "make the devices speak (open the door, switch the lamp); leave out the rules of devices that are gone";
        findings.push(Finding::limited("topics", found, remedy));
    } else {
        findings.push(all_heard(rules, path, &topics, place));
    }
    if let Some(counted) = &counted {
        findings.push(never(rules, counted, &fitted, &shown.to_string()));
    }
    findings.extend(payloads(rules, &topics, &shown.to_string()));
    let unnamed: Vec<&str> =
        topics.iter().map(|(topic, _)| *topic).filter(|topic| is_of_people(topic) && !is_fitted(topic)).collect();
    if !unnamed.is_empty() {
        let found = format!("{shown}: no rule reads {}: {}", count(unnamed.len(), "topic"), some_of(unnamed));
        let remedy = "write rules for those that say what people do; leave the others";
        findings.push(Finding::limited("unnamed topics", found, remedy));
    }
    findings
}

/// Every rule hears a topic now, or fitted a message before.
fn all_heard(rules: &Rules, path: &Path, topics: &[(&str, &[u8])], place: &Place<'_>) -> Finding {
    let all = rules.about().count();
    let hears = |number: usize| topics.iter().any(|(topic, _)| rules.fits(number, topic));
    let hearing = rules.about().filter(|rule| hears(rule.number)).count();
    let seen = count(topics.len(), "topic");
    match hearing {
        hearing if hearing == all => Finding::good("topics", format!("{seen} seen, and every rule hears one")),
        0 => Finding::limited(
            "topics",
            format!(
                "{}: nothing was said within {:.0} s under any topic of a rule; every rule fitted a message before",
                path.display(),
                place.wait.as_secs_f64()
            ),
            "switch something and ask again: a broker that was started again has no state until it changes, unless it keeps retained messages \
             (mosquitto: persistence true)",
        ),
        _ => Finding::good(
            "topics",
            format!("{seen} seen: {hearing} of {} hear one, the others fitted a message before", count(all, "rule")),
        ),
    }
}

/// The reason why no rule hears a topic, after `found`, and its remedy. `said` are the topics of others.
fn all_silent<'a>(
    rules: &Rules,
    bases: &[String],
    found: String,
    said: impl IntoIterator<Item = &'a str>,
) -> (String, String) {
    // The same topics under another base.
    let tail = |topic: &str| topic.split_once('/').map(|(_, tail)| tail.to_owned());
    let tails: Vec<String> = rules.about().filter_map(|rule| tail(rule.topic)).collect();
    let other = said.into_iter().find(|topic| tail(topic).is_some_and(|own| tails.contains(&own)));
    // Most rules are of Home Assistant, from `init`; added ones may be of any program.
    let topics_of = |wanted: &str| rules.about().filter(|rule| base(rule.topic) == wanted).count();
    let wanted = bases.iter().max_by_key(|base| topics_of(base)).map_or("homeassistant", String::as_str);
    match other.map(base) {
        Some(other) => (
            format!("{found}, and Home Assistant says its states under {other}/"),
            format!(
                "write {other}/ for {wanted}/ in the topics of the rules, or give mqtt_statestream base_topic: {wanted} and restart Home Assistant"
            ),
        ),
        None if !rules.about().any(|rule| is_of_statestream(rule.topic)) => (
            found,
            "switch something; if nothing comes then, look in the settings of the devices, or of what brings them to the broker, under which \
             topics they speak; roomcast narrate --mqtt --dry-run shows what comes"
                .to_owned(),
        ),
        None => (
            found,
            format!(
                "switch something: Home Assistant says a state when it changes; if nothing comes then, give its configuration.yaml \
                 mqtt_statestream: with base_topic: {wanted}, and restart it; roomcast narrate --mqtt --dry-run shows what comes"
            ),
        ),
    }
}

/// Topics of a rule with a last payload that no rule can read.
fn payloads(rules: &Rules, topics: &[(&str, &[u8])], shown: &str) -> Option<Finding> {
    // A payload that was too large to remember is empty.
    let filled = topics.iter().filter(|(topic, payload)| !payload.is_empty() && is_of_people(topic));
    let unread: Vec<_> = filled
        .filter_map(|(topic, payload)| {
            let (number, lack) = rules.unreadable(topic, payload)?;
            Some((topic, payload, number, lack))
        })
        .collect();
    let (topic, payload, number, lack) = unread.first()?;
    let others = unread.iter().skip(1).map(|(topic, ..)| **topic);
    let more = match unread.len() - 1 {
        0 => String::new(),
        _ => format!("; no rule can read the last payloads of {} either", some_of(others)),
    };
    let found =
        format!("{shown}: rule {number} reads {topic}, but its last payload {lack}: {}{more}", mqtt::shown(payload));
    let remedy = match lack.as_str() {
        "is no JSON" => {
            "leave `field` and pointers in braces out of the rule: then the payload is the value; or let the device say JSON"
        }
        _ => "roomcast narrate --mqtt --dry-run shows what comes; correct `field` and pointers in braces, or the topic",
    };
    Some(Finding::limited("payloads", found, remedy))
}

fn never(rules: &Rules, counted: &Counted, fitted: &[Option<u64>], shown: &str) -> Finding {
    let check = "rules that fit";
    let never: Vec<_> =
        rules.about().zip(fitted).filter(|(_, fitted)| **fitted == Some(0)).map(|(rule, _)| rule).collect();
    let hours = roomcast_services::clock::unix_ns().0 / 1_000_000_000;
    let hours = hours.saturating_sub(counted.since_unix_s) as f64 / 3600.0;
    if never.is_empty() {
        return Finding::good(check, format!("every rule that was counted fitted a message, in {hours:.1} h"));
    }
    if hours < COUNTED_H_MIN {
        let found = format!(
            "{} of {} fitted a message in the {:.0} minutes that they are counted; ask again after an hour",
            count(fitted.len() - never.len(), "rule"),
            fitted.len(),
            60.0 * hours
        );
        return Finding::good(check, found);
    }
    let names: Vec<String> = never
        .iter()
        .map(|rule| match rule.when {
            Some(when) => format!("rule {} ({} is {when:?})", rule.number, rule.topic),
            None => format!("rule {} ({})", rule.number, rule.topic),
        })
        .collect();
    let found =
        format!("{shown}: in {hours:.1} h no message ever fitted {}", some_of(names.iter().map(String::as_str)));
    Finding::limited(
        check,
        found,
        "use the device once and look at roomcast narrate --mqtt --dry-run; correct `topic` or `when`, or leave the rule out",
    )
}

/// Whether a topic may be about people: only some domains of Home Assistant's states, but all of other programs.
fn is_of_people(topic: &str) -> bool {
    let levels: Vec<&str> = topic.split('/').collect();
    match levels[..] {
        ["homeassistant", domain, _, "state"] => OF_PEOPLE.contains(&domain),
        ["homeassistant", ..] => false,
        _ => {
            !topic.contains("StateAttribute")
                && !topic.contains('$')
                && !topic.contains("Capability")
                && !topic.contains("MapData")
        }
    }
}

#[derive(Default)]
struct Heard {
    online: Option<bool>,
    status: Option<Status>,
    fault: String,
    segments: BTreeMap<String, String>,
    battery: bool,
    any: bool,
}

fn robot(config: &Config, map: Option<&SemanticMap>, seen: &Seen, place: &Place<'_>) -> Vec<Finding> {
    let check = "robot";
    let topic = &config.robot.topic;
    let dialect = Dialect::new(&config.robot, &config.bridge.topic, &config.planner.robot);
    let mut heard = Heard::default();
    for (topic, said) in &seen.topics {
        match dialect.hear(topic, &said.payload) {
            Some(Sensed::Online(online)) => (heard.online, heard.any) = (Some(online), true),
            Some(Sensed::Status(status)) => (heard.status, heard.any) = (Some(status), true),
            Some(Sensed::Fault(fault)) => (heard.fault, heard.any) = (fault, true),
            Some(Sensed::Segments(segments)) => (heard.segments, heard.any) = (segments, true),
            // The battery's sensor may be there while the robot is not.
            Some(Sensed::Battery(_)) => heard.battery = true,
            Some(Sensed::Resumes(_)) => heard.any = true,
            None => {}
        }
    }
    if !heard.any {
        return vec![no_robot(config, seen, place)];
    }
    let mut findings = Vec::new();
    if heard.online == Some(false) {
        let found = format!("the robot under {topic} is not connected");
        let remedy = "switch it on, and see whether its Wi-Fi reaches it";
        findings.push(Finding::wrong(check, found, remedy));
    } else if heard.status == Some(Status::Error) {
        let fault = if heard.fault.is_empty() { "it does not say which" } else { &heard.fault };
        let found = format!("the robot under {topic} has an error: {fault}");
        let remedy = "go and free it";
        findings.push(Finding::wrong(check, found, remedy));
    } else if !config.robot.obey {
        let found = format!("the robot speaks under {topic}, and is told nothing yet");
        let remedy = format!("when what `roomcast robot` prints is right: obey = true in [robot] of {}", place.shown());
        findings.push(Finding::limited(check, found, remedy));
    } else {
        findings.push(Finding::good(check, format!("speaks under {topic}, and obeys")));
    }
    if config.robot.obey && config.planner.reports != roomcast_services::config::Reports::Always {
        let found = "the robot obeys, and by planner.reports the clock may say that a room is done";
        let remedy = format!("set reports = \"always\" in [planner] of {}", place.shown());
        findings.push(Finding::limited("planner", found, remedy));
    }
    if config.robot.kind == RobotKind::HomeAssistant && !heard.battery {
        findings.push(no_battery(config, seen));
    }
    match (config.robot.kind, map) {
        (RobotKind::Valetudo, Some(map)) => findings.push(segments(config, map, &heard.segments, place)),
        (RobotKind::HomeAssistant, Some(map)) => findings.push(segments_of_home_assistant(config, map, place)),
        (_, None) => {}
    }
    findings
}

fn no_robot(config: &Config, seen: &Seen, place: &Place<'_>) -> Finding {
    let topic = &config.robot.topic;
    let others: Vec<&str> = (seen.topics.keys())
        .filter_map(|topic| {
            topic.strip_suffix("/$state").or_else(|| topic.strip_suffix("/StatusStateAttribute/status"))
        })
        .collect();
    let found = format!("no robot speaks under {topic} ({})", place.shown());
    let is_of_home_assistant = topic.contains("/vacuum/");
    let remedy = match others.first() {
        _ if config.robot.kind == RobotKind::HomeAssistant && others.contains(&topic.as_str()) => {
            "one that speaks Valetudo does: leave robot.kind out".to_owned()
        }
        _ if config.robot.kind == RobotKind::HomeAssistant && !is_of_home_assistant => {
            "set robot.topic to the vacuum's states, such as homeassistant/vacuum/NAME".to_owned()
        }
        _ if config.robot.kind == RobotKind::HomeAssistant => {
            "let the vacuum do something: Home Assistant says its state under this topic when it changes (mqtt_statestream)".to_owned()
        }
        _ if is_of_home_assistant => "set robot.kind = \"home-assistant\"".to_owned(),
        Some(other) => format!("set robot.topic = {other:?}, which is there"),
        None => "switch the robot on; in Valetudo connect it to this broker (Settings, Connectivity, MQTT); then set robot.topic to its \
                 prefix and identifier"
            .to_owned(),
    };
    Finding::wrong("robot", found, remedy)
}

/// Home Assistant has a vacuum's battery as a separate sensor.
fn no_battery(config: &Config, seen: &Seen) -> Finding {
    let vacuum = config.robot.topic.rsplit('/').next().unwrap_or_default();
    let sensor = format!("/sensor/{vacuum}_battery/state");
    let found = "no battery is heard of the robot: a low one does not keep it at its dock, and a room that it leaves to charge counts as done";
    let remedy = match (&config.robot.battery, seen.topics.keys().find(|topic| topic.ends_with(&sensor))) {
        (_, Some(there)) if config.robot.battery.as_ref() != Some(there) => {
            format!("set battery = {there:?} in [robot], which is there")
        }
        (Some(topic), _) => {
            format!(
                "let Home Assistant say {topic}, in percent: it does when the battery changes (mqtt_statestream); or set robot.battery to another topic"
            )
        }
        _ => format!("set robot.battery to the state topic of its battery's sensor, such as homeassistant{sensor}"),
    };
    Finding::limited("battery", found, remedy)
}

/// Checks whether each room has a segment name for Home Assistant's automation.
fn segments_of_home_assistant(config: &Config, map: &SemanticMap, place: &Place<'_>) -> Finding {
    let check = "segments";
    let file = place.shown();
    if let Some((found, remedy)) = segment_of_no_room(config, map, &file) {
        return Finding::wrong(check, found, remedy);
    }
    let own = by_ids(&config.robot.segments, map);
    let without: Vec<&str> =
        map.rooms().iter().map(|room| room.id.as_str()).filter(|room| !own.contains_key(*room)).collect();
    let Some(first) = without.first() else {
        let rooms = count(map.rooms().len(), "room");
        return Finding::good(check, format!("[robot.segments] of {file} has each of {rooms}"));
    };
    let found = format!(
        "[robot.segments] of {file} does not have {}: Home Assistant's automation gets the ids of these rooms",
        some_of(without.iter().copied())
    );
    let remedy = format!(
        "write there what the vacuum calls each room, such as {first:?} = \"16\", or its id where the automation goes by ids (docs/robot.md)"
    );
    Finding::limited(check, found, remedy)
}

/// Checks whether each room is a segment of the robot's own map.
fn segments(config: &Config, map: &SemanticMap, segments: &BTreeMap<String, String>, place: &Place<'_>) -> Finding {
    let check = "segments";
    let own = by_ids(&config.robot.segments, map);
    let rooms: Vec<&str> = map.rooms().iter().map(|room| room.id.as_str()).collect();
    let segment = |room: &str| segment_of(room, &rooms, &own, segments);
    let wrong: Vec<(&str, String)> = rooms.iter().filter_map(|room| Some((*room, segment(room).err()?))).collect();
    if segments.is_empty() && config.robot.segments.is_empty() {
        let effect = match wrong.len() {
            0 => "only the numbers in the rooms' ids are its segments",
            _ => "it can be sent to no room without a number in its id",
        };
        let found = format!("the robot under {} has told of no segments, so {effect}", config.robot.topic);
        let remedy =
            "let the robot divide its map into rooms (Valetudo, Map, Segments), and switch on map data for MQTT there";
        return Finding::wrong(check, found, remedy);
    }
    let known: Vec<String> = segments.iter().map(|(number, name)| format!("{number} {name:?}")).collect();
    let is_none = |number: &&String| !segments.is_empty() && !segments.contains_key(*number);
    let (file, table) = (place.shown(), &config.robot.segments);
    if let Some((room, number)) = table.iter().find(|(_, number)| is_none(number)) {
        let found = format!("[robot.segments] of {file} has {room:?} = {number:?}, and the robot has no such segment");
        return Finding::wrong(check, found, format!("write one of {}", some_of(known.iter().map(String::as_str))));
    }
    if let Some((found, remedy)) = segment_of_no_room(config, map, &file) {
        return Finding::wrong(check, found, remedy);
    }
    let Some((room, why)) = wrong.first() else {
        let found = format!("each of {} is a segment of the robot's map", count(map.rooms().len(), "room"));
        return Finding::good(check, found);
    };
    let names = some_of(wrong.iter().map(|(room, _)| *room));
    let found = format!(
        "the robot cannot do {names}: {room}: {why}; its segments are {}",
        some_of(known.iter().map(String::as_str))
    );
    // A segment that no room has yet: another would send the robot into the wrong room.
    let done: Vec<String> = rooms.iter().filter_map(|room| segment(room).ok()).collect();
    let number = segments.keys().find(|number| !done.contains(number)).map_or("NUMBER", String::as_str);
    let remedy = format!(
        "write each room's number into [robot.segments] of {}, such as {room:?} = {number:?}; or import the robot's own map; \
         one of another floor stays without",
        place.shown()
    );
    match wrong.len() == map.rooms().len() {
        true => Finding::wrong(check, found, remedy),
        false => Finding::limited(check, found, remedy),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::doctor::finding::Verdict;
    use roomcast_services::mqtt::tally::Tally;

    /// A robot without Valetudo does not list segments: only the configuration has them.
    #[test]
    fn rooms_that_home_assistant_gets_by_their_ids_are_named() {
        let map = SemanticMap::from_json(include_str!("../../../tests/data/two_rooms.json")).unwrap();
        let mut config = Config::default();
        config.robot.kind = RobotKind::HomeAssistant;
        config.robot.topic = "homeassistant/vacuum/dusty".to_owned();
        let place = Place { config: Path::new("roomcast.toml"), wait: std::time::Duration::ZERO };
        let mut seen = Seen::default();
        let message = look::Said { payload: b"docked".to_vec(), retained: true };
        seen.topics.insert("homeassistant/vacuum/dusty/state".to_owned(), message);
        let mut told = |segments: &[(&str, &str)]| {
            config.robot.segments = segments.iter().map(|(room, own)| (room.to_string(), own.to_string())).collect();
            let findings = robot(&config, Some(&map), &seen, &place);
            let found = findings.into_iter().find(|own| own.check == "segments").unwrap();
            (found.verdict, found.found)
        };
        let ids: Vec<&str> = map.rooms().iter().map(|room| room.id.as_str()).collect();
        let (verdict, found) = told(&[]);
        assert!(verdict == Verdict::Limited && ids.iter().all(|id| found.contains(id)), "{found}");
        let (verdict, found) = told(&[(ids[0], "16")]);
        assert!(verdict == Verdict::Limited && found.contains(&format!("have {}:", ids[1])), "{found}");
        assert_eq!(told(&[(&map.rooms()[0].label, "16"), (ids[1], "17")]).0, Verdict::Good, "by any name");
        assert_eq!(told(&[("attic", "16")]).0, Verdict::Wrong);
    }

    /// Regression: since 2026.8 Home Assistant's vacuums publish no battery, so the check looked in vain.
    #[test]
    fn a_robot_of_which_no_battery_is_heard_is_named() {
        let mut config = Config::default();
        config.robot.kind = RobotKind::HomeAssistant;
        config.robot.topic = "homeassistant/vacuum/dusty".to_owned();
        let place = Place { config: Path::new("roomcast.toml"), wait: std::time::Duration::ZERO };
        let (mut seen, sensor) = (Seen::default(), "homeassistant/sensor/dusty_battery/state");
        let said = |payload: &[u8]| look::Said { payload: payload.to_vec(), retained: true };
        let remedy = |config: &Config, seen: &Seen| {
            let found = robot(config, None, seen, &place).into_iter().find(|own| own.check == "battery");
            found.map(|finding| finding.remedy.unwrap_or_default())
        };
        seen.topics.insert("homeassistant/vacuum/dusty/state".to_owned(), said(b"docked"));
        assert!(remedy(&config, &seen).unwrap().contains(&format!("such as {sensor}")));
        seen.topics.insert(sensor.to_owned(), said(b"62"));
        assert!(remedy(&config, &seen).unwrap().contains(&format!("battery = {sensor:?}")));
        config.robot.battery = Some(sensor.to_owned());
        assert_eq!(remedy(&config, &seen), None);
        seen.topics.insert(sensor.to_owned(), said(b"unavailable"));
        assert!(remedy(&config, &seen).unwrap().starts_with("let Home Assistant say"));
    }

    /// Earlier counts do not prove present messages.
    #[test]
    fn topics_are_seen_only_where_something_is_said() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rules.toml");
        let rule = |topic: &str| {
            format!("[[rule]]\ntopic = \"home/{topic}\"\nwhen = \"on\"\nsay = \"They use the {topic}.\"\n")
        };
        std::fs::write(&path, rule("oven") + &rule("lamp")).unwrap();
        let rules = Rules::load(&path).unwrap();
        let mut config = Config::default();
        config.daemon.state = Some(folder.path().to_owned());
        let state = config.daemon.state_directory().unwrap();
        std::fs::create_dir_all(&state).unwrap();
        Tally::new(&state, &config.narrator.name, rules.keys()).keep(&[3, 3], true);
        let place = Place { config: &path, wait: std::time::Duration::from_secs(5) };
        let told = |said: &[&str]| {
            let mut seen = Seen::default();
            let message = look::Said { payload: b"on".to_vec(), retained: true };
            seen.topics.extend(said.iter().map(|topic| (format!("home/{topic}"), message.clone())));
            let findings = topics(&rules, &path, &seen, &config, &place);
            let found = findings.into_iter().find(|own| own.check == "topics").unwrap();
            (found.verdict, found.found)
        };
        let (verdict, found) = told(&[]);
        assert_eq!(verdict, Verdict::Limited, "{found}");
        assert!(
            found
                .ends_with("nothing was said within 5 s under any topic of a rule; every rule fitted a message before"),
            "{found}"
        );
        let some = "1 topic seen: 1 of 2 rules hear one, the others fitted a message before";
        assert_eq!(told(&["oven"]), (Verdict::Good, some.to_owned()));
        assert_eq!(told(&["oven", "lamp"]), (Verdict::Good, "2 topics seen, and every rule hears one".to_owned()));
    }

    /// Regression: the remedy for Home Assistant named the topics of Zigbee2MQTT.
    #[test]
    fn only_home_assistants_topics_are_set_in_home_assistant() {
        for own in ["homeassistant/sensor/a/state", "homeassistant/#", "home/binary_sensor/hall/state"] {
            assert!(is_of_statestream(own), "{own}");
        }
        for other in ["zigbee2mqtt/hall", "zigbee2mqtt/+", "frigate/events", "b/#", "shelly/relay/state"] {
            assert!(!is_of_statestream(other), "{other}");
        }
    }
}
