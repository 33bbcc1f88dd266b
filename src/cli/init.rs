//! `roomcast init`: writes a home's map, rules and configuration from the home's own data.
//!
//! Sources that are not given are searched for (a broker on this machine, a Home Assistant's folder, a robot at the broker), and on a terminal the
//! user is asked. Everything is read and checked before the first file is written, and no existing file is overwritten without consent.

use std::fmt::Write as _;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use roomcast_core::grounding::Grounding;
use roomcast_core::semantic_map::import::{self, Furnish, Imported};
use roomcast_core::semantic_map::{MAX_FILE_BYTES, SemanticMap};
use roomcast_services::config::{Config, WhileAsleep};

mod areas;
mod ask;
mod configuration;
mod find;
mod join;

use areas::Areas;
use ask::Asker;
use configuration::configuration;
use find::{Found, find, is_none, no_rooms};
use join::{in_rooms_of, inside, rules_in, with_things};

use super::choice::choice;
use super::home_source::{check_rules, is_url};
use super::scene_files::{in_file, in_map, input, read, segment_names, write};
use super::{CommandResult, Failure, count, print};

/// Valetudo's topic of the map, after its prefix and identifier.
const MAP: &str = "/MapData/map-data";
/// Files and folder in the configuration's folder. It names them relative to itself, so that all can be moved together to the place where the units
/// read them.
const SCENE_FILE: &str = "home.json";
const RULES_FILE: &str = "home.rules.toml";
const STATE_FOLDER: &str = "state";
const FOLDER: &str = "home";

#[derive(Debug, clap::Args)]
pub struct Args {
    /// The folder for home.json, home.rules.toml and roomcast.toml; it is made if it is missing.
    #[arg(long, value_name = "FOLDER", default_value = FOLDER)]
    out: PathBuf,
    /// The same as --out.
    #[arg(value_name = "FOLDER", conflicts_with = "out", hide = true)]
    folder: Option<PathBuf>,
    /// Home Assistant: its configuration folder, or its address (http://HOST:8123) with --token-file; `none` for a home without.
    #[arg(long, value_name = "FOLDER|URL|none")]
    home_assistant: Option<PathBuf>,
    /// A file with a long-lived access token of the Home Assistant at an address; only its owner may be able to read it.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// A PEM file with the certificates of the Home Assistant's certificate authority, for an https address.
    #[arg(long, value_name = "FILE", requires = "token_file")]
    ca: Option<PathBuf>,
    /// An area of Home Assistant that becomes no room, by its name or id; once for each.
    #[arg(long, value_name = "AREA")]
    leave_out: Vec<String>,
    /// The broker: `mqtt://HOST[:PORT]`, or `mqtts://HOST[:PORT]` with --mqtt-ca; `none` for a home without.
    #[arg(long, value_name = "URL|none")]
    mqtt: Option<String>,
    /// A file with the broker's user name and password, a line each.
    #[arg(long, value_name = "FILE")]
    mqtt_credentials: Option<PathBuf>,
    /// A PEM file with the certificates of the broker's certificate authority.
    #[arg(long, value_name = "FILE")]
    mqtt_ca: Option<PathBuf>,
    /// A robot's map: the file that Valetudo exports, or `mqtt` for the map at the broker; `none` for a home without.
    #[arg(long, value_name = "FILE|mqtt|none")]
    valetudo: Option<PathBuf>,
    /// Names for the segments of the robot's map: a TOML file with a line such as `11 = "kitchen"` each.
    #[arg(long, value_name = "FILE")]
    names: Option<PathBuf>,
    /// The robot's topic at the broker: Valetudo's prefix and identifier, or homeassistant/vacuum/NAME; `none` for a home without.
    #[arg(long, value_name = "TOPIC|none")]
    robot: Option<String>,
    /// A resident's name; once for each, or with commas between. Other persons are visitors. Without it, the persons of Home Assistant; `none` for no
    /// list, so that no person counts as a visitor.
    #[arg(long, value_name = "NAME|none")]
    resident: Vec<String>,
    /// Hours in which no robot works, such as `22:00-07:00` or `sat,sun 22:00-09:00`; once for each, or with semicolons between; `none` for none.
    #[arg(long, value_name = "HOURS|none")]
    quiet: Vec<String>,
    /// Rooms that the robot avoids while a person sleeps.
    #[arg(long, value_name = "ROOMS", value_parser = choice::<WhileAsleep>())]
    while_asleep: Option<WhileAsleep>,
    /// Which rooms get the usual furniture of their kind; ids of such things begin with "assumed". With a robot's map, this is decided before Home
    /// Assistant's things are added.
    #[arg(long, value_name = "WHICH", value_parser = choice::<Furnish>(), default_value_t)]
    furnish: Furnish,
    /// Leave all rooms as they are, without assumed furniture.
    #[arg(long, conflicts_with = "furnish")]
    bare: bool,
    /// Replace existing files. Each old file is kept as NAME.old.
    #[arg(long)]
    replace: bool,
    /// Ask no question, also on a terminal.
    #[arg(long)]
    yes: bool,
}

pub fn run(args: &Args) -> CommandResult {
    let mut asker = Asker::new(args.yes);
    let folder = args.folder.as_ref().unwrap_or(&args.out);
    let folder =
        std::path::absolute(folder).map_err(|error| input(format!("the folder {}: {error}", folder.display())))?;
    let files = [SCENE_FILE, RULES_FILE, "roomcast.toml"].map(|name| folder.join(name));
    permit(&files, args.replace, &mut asker)?;
    let found = find(args, &mut asker)?;
    let made = make(args, &files, &found)?;
    std::fs::create_dir_all(&folder).map_err(|error| {
        let text =
            format!("cannot make the folder {}: {error}; check its permissions, or give another one", folder.display());
        Failure::failed(text)
    })?;
    let [scene, rules, config] = &files;
    let mut report = made.report(&files, &found);
    let scene_text = made.map.to_json();
    let texts = [(scene, Some(&scene_text)), (rules, made.rules.as_ref()), (config, Some(&made.config))];
    for (path, text) in texts.iter().filter_map(|(path, text)| Some((path, text.as_ref()?))) {
        if let Some(old) = keep_old(path, text)? {
            let _ = writeln!(report, "\nThe old {} is now {}", path.display(), old.display());
        }
        write(path, text.as_bytes())?;
    }
    print(&report)
}

/// Moves an existing file with another text aside: a user may have edited it. Returns its new name.
fn keep_old(path: &Path, text: &str) -> Result<Option<PathBuf>, Failure> {
    const MOST: usize = 1_000;
    let is_same = || std::fs::read(path).is_ok_and(|old| old == text.as_bytes());
    if !path.exists() || is_same() {
        return Ok(None);
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let names = (1..MOST).map(|number| match number {
        1 => path.with_file_name(format!("{name}.old")),
        _ => path.with_file_name(format!("{name}.old-{number}")),
    });
    let free = names.into_iter().find(|name| !name.exists());
    let failed = |why: String| {
        let text = format!("cannot keep the old {}: {why}; move it away, or give another folder", path.display());
        Failure::failed(text)
    };
    let old = free.ok_or_else(|| failed("too many old files are there".to_owned()))?;
    std::fs::rename(path, &old).map_err(|error| failed(error.to_string()))?;
    Ok(Some(old))
}

fn permit(files: &[PathBuf], replace: bool, asker: &mut Asker) -> CommandResult {
    let there: Vec<String> = files.iter().filter(|path| path.exists()).map(|path| path.display().to_string()).collect();
    if let Some(path) = files.iter().find(|path| path.exists() && !path.is_file()) {
        let text = format!("{} is there and is no file; give another folder", path.display());
        return Err(Failure::failed(text));
    }
    if there.is_empty() || replace {
        return Ok(());
    }
    let names = there.join(", ");
    if asker.yes_or_no(&format!("Replace {names}? The old files stay, as NAME.old."), false)? == Some(true) {
        return Ok(());
    }
    let text = format!(
        "{names} stay as they are: give another folder with --out, or --replace for new files (the old ones stay, as NAME.old)"
    );
    Err(Failure::failed(text))
}

struct Made {
    map: SemanticMap,
    rules: Option<String>,
    config: String,
    notes: Vec<String>,
}

fn make(args: &Args, files: &[PathBuf; 3], found: &Found) -> Result<Made, Failure> {
    let [scene, rules_file, config_file] = files;
    let plan = robot_map(args, found)?;
    let home = found.home_assistant.as_ref().map(|(_, home)| home);
    let (home_map, rules) = (home.map(|home| home.imported.clone()), home.and_then(|home| home.rules.clone()));
    let furnish = |imported: Imported| if args.bare { Ok(imported) } else { imported.furnish(args.furnish) };
    let (imported, areas) = match (plan, home_map) {
        (Some(plan), areas) => (plan, areas),
        (None, Some(areas)) => (areas, None),
        (None, None) => return Err(no_rooms()),
    };
    let (imported, known) = match &areas {
        Some(Imported { map: areas, .. }) => Areas::find(imported, areas)?,
        None => (imported, Areas::default()),
    };
    let imported = furnish(imported).map_err(|error| in_file("the map", scene, &error))?;
    let (mut map, mut notes, mut rules) = (imported.map, imported.notes, rules);
    if let Some(Imported { map: areas, .. }) = &areas {
        map = with_things(&map, areas, &known, &mut notes)?;
        // Without a rule there is no valid file of rules.
        rules = rules.map(|text| in_rooms_of(&map, areas, &known, &text, &mut notes)).filter(|text| rules_in(text) > 0);
    }
    if let Some(text) = &rules {
        check_rules(rules_file, text)?;
    }
    let config = configuration(&map, rules.is_some(), found);
    let checked: Config = config.parse().map_err(|error| input(format!("{}: {error}", config_file.display())))?;
    checked.check()?;
    // The services will read exactly this configuration and map.
    Grounding::new(&map, &checked.grounding)?;
    Ok(Made { map, rules, config, notes })
}

/// The robot's own map, from a file or from the broker.
fn robot_map(args: &Args, found: &Found) -> Result<Option<Imported>, Failure> {
    let over_broker = found.valetudo.as_deref() == Some(Path::new("mqtt"));
    let told = || {
        let robot = found.robot.as_ref()?;
        found.seen.topics.get(&format!("{robot}{MAP}"))
    };
    let (json, from) = match &found.valetudo {
        Some(path) if is_none(path) => return Ok(None),
        Some(path) if !over_broker => (read("map", path)?, path.clone()),
        _ => match told() {
            Some(said) => {
                let robot = PathBuf::from(format!("{}{MAP}", found.robot.as_deref().unwrap_or_default()));
                (unpacked(&said.payload).map_err(|fault| input(format!("map {}: {fault}", robot.display())))?, robot)
            }
            None if over_broker && found.broker.is_none() => {
                let text = "--valetudo mqtt is the map that the robot tells a broker, and there is none: give --mqtt, or --valetudo FILE";
                return Err(Failure::usage(text));
            }
            None if over_broker => {
                let robot = found.robot.as_deref().unwrap_or("any robot");
                let text = format!(
                    "no map of {robot} is at the broker: switch on \"map data\" in Valetudo (Settings, Connectivity, MQTT, Customizations), \
                     or save http://ROBOT/api/v2/robot/state/map and give --valetudo FILE"
                );
                return Err(input(text));
            }
            None => return Ok(None),
        },
    };
    import_map(args, &json, &from).map(Some)
}

/// A robot's map, with the given names for its segments.
fn import_map(args: &Args, json: &str, from: &Path) -> Result<Imported, Failure> {
    let names = match &args.names {
        Some(path) => segment_names(path)?,
        None => Default::default(),
    };
    import::valetudo(json, "home", &names).map_err(|error| in_map(from, args.names.as_deref(), &error))
}

/// A map as the robot publishes it: zlib, or plain.
fn unpacked(payload: &[u8]) -> Result<String, String> {
    let text = if payload.first() == Some(&b'{') {
        String::from_utf8(payload.to_vec()).map_err(|_| "it is not UTF-8".to_owned())?
    } else {
        let mut text = String::new();
        let packed = flate2::read::ZlibDecoder::new(payload);
        packed
            .take(MAX_FILE_BYTES + 1)
            .read_to_string(&mut text)
            .map_err(|error| format!("it cannot be unpacked: {error}"))?;
        text
    };
    if text.len() as u64 > MAX_FILE_BYTES {
        return Err(format!("it has more than {MAX_FILE_BYTES} bytes"));
    }
    Ok(text)
}

impl Made {
    fn report(&self, [scene, rules, config]: &[PathBuf; 3], found: &Found) -> String {
        let mut text = String::new();
        for note in &found.notes {
            let _ = writeln!(text, "{note}");
        }
        let (rooms, things) = (count(self.map.rooms().len(), "room"), count(self.map.items().len(), "thing"));
        let _ = writeln!(text, "{}: {rooms}, {things}", scene.display());
        for note in &self.notes {
            let _ = writeln!(text, "  {note}");
        }
        if let Some(written) = &self.rules {
            let number = count(rules_in(written), "rule");
            let _ = writeln!(text, "{}: {number}; delete the rules that say nothing about people", rules.display());
        }
        let file = config.display();
        let _ = writeln!(text, "{file}\n\nNow look at it, and see what is missing:\n");
        let _ = writeln!(text, "  roomcast scene draw {} --out home.svg", scene.display());
        let _ = writeln!(text, "  roomcast doctor --config {file}");
        let (has_broker, has_robot) = (found.broker.is_some(), found.robot.is_some());
        let narrates = has_broker && self.rules.is_some();
        if narrates {
            let _ = writeln!(text, "  roomcast narrate --mqtt --config {file} --dry-run");
        }
        text.push_str("\nThen start it, each in a terminal of its own, or as services (docs/home.md):\n\n");
        for (is_needed, service) in [
            (true, "daemon"),
            (narrates, "narrate --mqtt"),
            (true, "planner"),
            (has_broker, "publish mqtt"),
            (has_robot, "robot"),
            (true, "view"),
        ] {
            if is_needed {
                let _ = writeln!(text, "  roomcast {service} --config {file}");
            }
        }
        if has_robot {
            let _ = writeln!(
                text,
                "\n`roomcast robot` only prints what the robot would be told, until [robot] of\n{file}\nhas obey = true."
            );
        }
        if let Some((url, _)) = found.home_assistant.as_ref().filter(|(home, _)| is_url(home)) {
            let _ = writeln!(text, "\nThe token for {} is no longer needed: you can revoke it there.", url.display());
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::configuration::name_of_robot;
    use super::find::{LOCAL_BROKER, QUIET, find_broker};
    use super::*;
    use crate::exit_code;
    use roomcast_core::semantic_map::import::{Home, Registries};
    use roomcast_services::config::QuietHours;
    use roomcast_services::mqtt::Broker;
    use roomcast_services::mqtt::look::Seen;
    use serde_json::json;
    use std::io::Write as _;

    #[derive(clap::Parser)]
    struct Line {
        #[command(flatten)]
        args: Args,
    }

    #[test]
    fn a_robots_map_is_unpacked_with_a_limit() {
        let mut packed = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
        packed.write_all(br#"{"layers": []}"#).unwrap();
        let packed = packed.finish().unwrap();
        assert_eq!(unpacked(&packed).unwrap(), r#"{"layers": []}"#);
        assert_eq!(unpacked(br#"{"a": 1}"#).unwrap(), r#"{"a": 1}"#);
        assert!(unpacked(b"PNG").unwrap_err().contains("cannot be unpacked"));
        let mut bomb = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
        for _ in 0..70 {
            bomb.write_all(&vec![b' '; 1 << 20]).unwrap();
        }
        assert!(unpacked(&bomb.finish().unwrap()).unwrap_err().contains("more than"));
    }

    #[test]
    fn a_malformed_broker_is_refused_before_it_is_listened_to() {
        let line = <Line as clap::Parser>::try_parse_from(["init", "home"]).unwrap();
        let (mut shown, output) = std::io::pipe().unwrap();
        let mut asker = Asker::of(&b"http://hub\nnone\n"[..], output);
        assert!(find_broker(&line.args, &mut asker, &mut Vec::new()).unwrap().0.is_none());
        drop(asker);
        let mut text = String::new();
        std::io::Read::read_to_string(&mut shown, &mut text).unwrap();
        assert!(text.contains("\"http://hub\" is no broker") && !text.contains("Listening"), "{text}");
    }

    #[test]
    fn a_home_without_any_source_of_rooms_gets_no_further_question() {
        let line = <Line as clap::Parser>::parse_from(["init", "--home-assistant", "none"]);
        let failure = find(&line.args, &mut Asker::of(&b"none\n"[..], std::io::sink())).err().unwrap();
        assert_eq!(failure.code, exit_code::USAGE);
        assert!(failure.to_string().contains("write the map by hand (scenes/README.md)"), "{failure}");
    }

    fn home_of(areas: &[(&str, &str)]) -> Home {
        let area = |(id, name): &(&str, &str)| json!({"id": id, "name": name});
        let sensor = |(id, _): &(&str, &str)| json!({"entity_id": format!("binary_sensor.{id}"), "area_id": id, "original_device_class": "motion"});
        let areas_text = json!({"data": {"areas": areas.iter().map(area).collect::<Vec<_>>()}}).to_string();
        let entities = json!({"data": {"entities": areas.iter().map(sensor).collect::<Vec<_>>()}}).to_string();
        let registries = Registries { areas: &areas_text, entities: Some(&entities), ..Registries::default() };
        import::home_assistant(&registries, "home").unwrap()
    }

    #[test]
    fn a_robots_name_is_nobodys_unless_a_resident_has_it() {
        let residents = ["Rosie".to_owned(), "Ada Lovelace".to_owned()];
        for (robot, name) in [
            ("homeassistant/vacuum/staubi", Some("Staubi")),
            ("valetudo/upper_floor-robot", Some("Upper floor robot")),
            ("valetudo/rosie", None),
            ("valetudo/ada", None),
            ("valetudo/42", None),
            ("valetudo/", None),
        ] {
            assert_eq!(name_of_robot(robot, &residents).as_deref(), name, "{robot}");
        }
    }

    /// A home is set up in a user's folder, and moved to the units' folder.
    #[test]
    fn the_files_can_be_moved_together() {
        let broker = Broker {
            address: LOCAL_BROKER.to_owned(),
            client: "init".to_owned(),
            credentials: Some("/home/ada/secret".into()),
            authority: None,
        };
        let found = Found {
            broker: Some(broker),
            seen: Seen::default(),
            home_assistant: None,
            robot: None,
            valetudo: None,
            quiet: vec![QuietHours::try_from(QUIET.to_owned()).unwrap()],
            while_asleep: WhileAsleep::default(),
            residents: Vec::new(),
            notes: Vec::new(),
        };
        let map = home_of(&[("kuche", "Küche")]).imported.map;
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(SCENE_FILE), "{}").unwrap();
        let file = folder.path().join("roomcast.toml");
        for has_rules in [true, false] {
            // The commented line for rules names the same file.
            let text = configuration(&map, has_rules, &found).replace("# rules = ", "rules = ");
            std::fs::write(&file, text).unwrap();
            let Config { scene, daemon, mqtt, .. } = Config::load(&file).unwrap();
            let at = |name: &str| Some(folder.path().join(name));
            assert_eq!([scene.path, daemon.state, mqtt.rules], [SCENE_FILE, STATE_FOLDER, RULES_FILE].map(at));
            assert_eq!(mqtt.credentials, Some("/home/ada/secret".into()));
        }
    }

    #[test]
    fn a_home_gets_quiet_hours_sleep_and_the_segments_that_home_assistant_knows() {
        let areas = json!({"data": {"areas": [{"id": "kitchen", "name": "Kitchen"}, {"id": "hall", "name": "Hall"}]}});
        let options = json!({"vacuum": {"area_mapping": {"kitchen": ["16"]}}});
        let vacuum = json!({"entity_id": "vacuum.dusty", "options": options});
        let entities = json!({"data": {"entities": [vacuum]}}).to_string();
        let areas = areas.to_string();
        let registries = Registries { areas: &areas, entities: Some(&entities), ..Registries::default() };
        let home = import::home_assistant(&registries, "home").unwrap();
        let map = home.imported.map.clone();
        let found = Found {
            broker: None,
            seen: Seen::default(),
            home_assistant: Some((PathBuf::from("/config"), home)),
            robot: Some("homeassistant/vacuum/dusty".to_owned()),
            valetudo: None,
            residents: Vec::new(),
            quiet: vec![QuietHours::try_from("sat,sun 22:00-09:00".to_owned()).unwrap()],
            while_asleep: WhileAsleep::House,
            notes: Vec::new(),
        };
        let config: Config = toml::from_str(&configuration(&map, false, &found)).unwrap();
        assert_eq!((&config.planner.quiet, config.planner.while_asleep), (&found.quiet, WhileAsleep::House));
        assert_eq!(config.robot.segments, [("kitchen".to_owned(), "16".to_owned())].into());
    }

    /// Programs must not act on guesses of `init`: the remaining rules name rooms by their ids.
    #[test]
    fn rules_of_areas_that_no_room_is_known_to_be_are_comments() {
        let rooms = |names: &[&str]| {
            let room = |(at, name): (u32, &&str)| {
                let bounds = json!({"min_m": [4 * at, 0, 0], "max_m": [4 * at + 4, 4, 2.5]});
                json!({"id": format!("{name}-{at}"), "label": name, "box": bounds})
            };
            let rooms: Vec<_> = (1..).zip(names).map(room).collect();
            let scene = json!({"format": "roomcast-scene", "version": 1, "name": "home", "rooms": rooms, "items": []});
            SemanticMap::from_json(&scene.to_string()).unwrap()
        };
        let map = rooms(&["kitchen", "bathroom", "hallway", "hallway"]);
        let areas =
            [("kuche", "Küche"), ("bad", "Bad"), ("bad_gaste", "Bad Gäste"), ("flur", "Flur"), ("turm", "Turm")];
        let home = home_of(&areas);
        let mut notes = Vec::new();
        let of = |areas: &SemanticMap| {
            Areas::find(Imported { map: map.clone(), notes: Vec::new(), boxed: Vec::new() }, areas).unwrap()
        };
        let (same, known) = of(&home.imported.map);
        assert_eq!(same.map, map, "all are of one floor");
        let text = in_rooms_of(&map, &home.imported.map, &known, home.rules.as_deref().unwrap(), &mut notes);
        let rules: toml::Table = text.parse().unwrap();
        let named: Vec<_> =
            rules["rule"].as_array().unwrap().iter().map(|rule| rule["room"].as_str().unwrap()).collect();
        assert_eq!(named, ["kitchen-1"], "{text}");
        assert_eq!((rules_in(&text), notes.len()), (1, 1), "{text}{notes:?}");
        assert!(
            notes[0].starts_with("4 rules of the areas \"bad\", \"bad_gaste\", \"flur\", \"turm\" written"),
            "{notes:?}"
        );
        assert!(
            text.contains("# room = \"bad_gaste\"\n") && text.contains("Write one of kitchen-1, bathroom-2, hallway-3"),
            "{text}"
        );
        // Without the comment signs, they are the original rules.
        let all = text.replace("# [[rule]]", "[[rule]]").replace("# topic", "topic").replace("# when", "when");
        let all = all.replace("# sensor", "sensor").replace("# id", "id").replace("# room", "room");
        assert_eq!(all.parse::<toml::Table>().unwrap()["rule"].as_array().unwrap().len(), areas.len(), "{all}");
        let none = home_of(&[("turm", "Turm")]);
        let text = in_rooms_of(
            &map,
            &none.imported.map,
            &of(&none.imported.map).1,
            none.rules.as_deref().unwrap(),
            &mut notes,
        );
        assert_eq!(rules_in(&text), 0, "{text}");
    }
}
