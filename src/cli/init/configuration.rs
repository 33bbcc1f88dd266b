//! The configuration file that `roomcast init` writes.

use std::fmt::Write as _;
use std::path::Path;

use roomcast_core::narration::{ReadName, check_name};
use roomcast_core::semantic_map::SemanticMap;

use super::find::{Found, is_of_home_assistant};
use super::{RULES_FILE, SCENE_FILE, STATE_FOLDER};

/// The robot's name from its topic at the broker, unless a resident has it.
pub(super) fn name_of_robot(robot: &str, residents: &[String]) -> Option<String> {
    let words = robot.rsplit('/').next()?.replace(['_', '-'], " ");
    let mut letters = words.trim().chars();
    let name = letters.next()?.to_uppercase().chain(letters).collect::<String>();
    let is_taken = |name: &String| {
        let name = ReadName::new(name);
        let is_of = |resident: ReadName| resident.may_be_one(&name) || resident.first.as_ref() == Some(&name.letters);
        residents.iter().map(|resident| ReadName::new(resident)).any(is_of)
    };
    Some(name).filter(|name| check_name(name).is_ok() && !is_taken(name))
}

pub(super) fn configuration(map: &SemanticMap, has_rules: bool, found: &Found) -> String {
    let quoted = |text: &str| toml::Value::from(text).to_string();
    let path = |path: &Path| quoted(&path.to_string_lossy());
    let mut text = format!(
        "# A home, as `roomcast init` has set it up. `roomcast config` prints every key with its default; `roomcast doctor --config` says what\n\
         # is wrong. Every service reads this file. A relative path begins at this file's folder.\n\n[scene]\npath = {}\n\n[daemon]\n\
         # What was narrated and learned is kept here over restarts; under systemd, in the folder that the unit has for it.\nstate = {}\n",
        quoted(SCENE_FILE),
        quoted(STATE_FOLDER)
    );
    text.push_str("\n[narrator]\nname = \"home\"\n");
    let names: Vec<String> = found.residents.iter().map(|name| quoted(name)).collect();
    let residents = match names.len() {
        0 => "# Who lives here; with names, everybody else is a visitor.\n# residents = [\"Ada\", \"Ben\"]".to_owned(),
        _ => format!("# Everybody else is a visitor.\nresidents = [{}]", names.join(", ")),
    };
    let not_persons = match found.robot.as_deref().and_then(|robot| name_of_robot(robot, &found.residents)) {
        Some(name) => format!("not_persons = [{}]", quoted(&name)),
        None => "# not_persons = [\"Rocky\"]".to_owned(),
    };
    let _ = write!(
        text,
        "\n[persons]\n{residents}\n# Pets, robots and devices that have names: what a sentence says of one, it says of nobody.\n{not_persons}\n"
    );
    if let Some(broker) = &found.broker {
        let _ = write!(text, "\n[mqtt]\nbroker = {}\n", quoted(&broker.address));
        for (key, file) in [("credentials", broker.credentials.as_deref()), ("ca", broker.authority.as_deref())] {
            if let Some(file) = file {
                let _ = writeln!(text, "{key} = {}", path(file));
            }
        }
        let rules = format!("rules = {}", quoted(RULES_FILE));
        let _ = match has_rules {
            true => writeln!(text, "{rules}"),
            false => {
                writeln!(text, "# When you have written this file (docs/mqtt.md), take out the sign #.\n# {rules}")
            }
        };
    }
    let quiet: Vec<String> = found.quiet.iter().map(|hours| quoted(&hours.to_string())).collect();
    let _ = write!(
        text,
        "\n[planner]\n# No robot works in these hours, nor there while a person sleeps (docs/wishes.md).\nquiet = [{}]\nwhile_asleep = {}\n",
        quiet.join(", "),
        quoted(&found.while_asleep.to_string())
    );
    if let Some(robot) = &found.robot {
        let _ = write!(
            text,
            "# A room is done when the robot says so, and never by the clock.\nreports = \"always\"\n\
             # Every room once a day, from the planner's start on.\nround_s = 86400.0\n\n[robot]\n{}topic = {}\n\
             # Only what it would be told is printed, until this is true.\nobey = false\n",
            if is_of_home_assistant(robot) { "kind = \"home-assistant\"\n" } else { "" },
            quoted(robot)
        );
        if is_of_home_assistant(robot) {
            let vacuum = robot.rsplit('/').next().unwrap_or_default();
            let _ = writeln!(
                text,
                "# Its battery, where Home Assistant has it as a sensor of its own.\n# battery = {}",
                quoted(&format!("homeassistant/sensor/{vacuum}_battery/state"))
            );
            text.push_str(
                "\n# What the vacuum itself calls each room; without it, Home Assistant's automation gets the room's id (docs/robot.md).\n",
            );
            let known =
                found.home_assistant.as_ref().and_then(|(_, home)| home.segments.get(&format!("vacuum.{vacuum}")));
            let is_known = map.rooms().iter().any(|room| known.is_some_and(|known| known.contains_key(&room.id)));
            text.push_str(if is_known { "[robot.segments]\n" } else { "# [robot.segments]\n" });
            for room in map.rooms() {
                let _ = match known.and_then(|known| known.get(&room.id)) {
                    Some(segment) => writeln!(text, "{} = {}", quoted(&room.id), quoted(segment)),
                    None => writeln!(text, "# {} = \"NUMBER\"", quoted(&room.id)),
                };
            }
        }
    }
    text
}
