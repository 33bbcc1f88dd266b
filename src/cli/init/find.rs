//! A home's sources. Options name them; otherwise `init` searches for them, and asks on a terminal.

use std::path::{Path, PathBuf};
use std::time::Duration;

use roomcast_core::semantic_map::import::{Home, Registries};
use roomcast_services::config::{Config, QuietHours, WhileAsleep};
use roomcast_services::mqtt::look::{self, LookError, Seen};
use roomcast_services::mqtt::{Broker, MqttError};
use strum::VariantArray;

use super::ask::Asker;
use super::{Args, CommandResult, Failure, MAP, import_map, input};
use crate::cli::home_source::{HomeOptions, home_assistant, is_url};
use crate::cli::scene_files::read;

const LOOK: Duration = Duration::from_secs(3);
/// The broker that is tried by default.
pub(super) const LOCAL_BROKER: &str = "mqtt://127.0.0.1";
/// Usual places of a Home Assistant's configuration, also below the user's home.
const FOLDERS: [&str; 4] =
    ["/config", "/var/lib/homeassistant", "/usr/share/hassio/homeassistant", "/home/homeassistant/.homeassistant"];
const OWN_FOLDER: &str = ".homeassistant";
/// Valetudo's topic of its state, after its prefix and identifier.
const STATUS: &str = "/StatusStateAttribute/status";
pub(super) const QUIET: &str = "22:00-07:00";
/// The token's file name in docs/home.md.
const TOKEN_FILE: &str = "token";

pub(super) struct Found {
    pub(super) broker: Option<Broker>,
    pub(super) seen: Seen,
    pub(super) home_assistant: Option<(PathBuf, Home)>,
    pub(super) robot: Option<String>,
    /// The file with the robot's map, `mqtt`, or `none`.
    pub(super) valetudo: Option<PathBuf>,
    pub(super) residents: Vec<String>,
    pub(super) quiet: Vec<QuietHours>,
    pub(super) while_asleep: WhileAsleep,
    pub(super) notes: Vec<String>,
}

pub(super) fn find(args: &Args, asker: &mut Asker) -> Result<Found, Failure> {
    let mut notes = Vec::new();
    let (mut home_assistant, token) = find_home_assistant(args, asker, &mut notes)?;
    if home_assistant.is_none() && !args.leave_out.is_empty() {
        let text = "--leave-out names an area of Home Assistant, and there is none: give --home-assistant, or remove --leave-out";
        return Err(Failure::usage(text));
    }
    let (broker, seen) = find_broker(args, asker, &mut notes)?;
    let robot = match args.robot.as_deref() {
        Some("none") => None,
        Some(given) => Some(given_robot(given, &seen, &mut notes)),
        None => find_robot(&seen, broker.is_some(), asker, &mut notes)?,
    };
    if broker.is_none() {
        of_no_broker(args, robot.is_some())?;
    }
    let valetudo = find_map(args, robot.as_deref(), &seen, asker, &mut notes)?;
    let is_told = robot.as_ref().is_some_and(|robot| seen.topics.contains_key(&format!("{robot}{MAP}")));
    if !valetudo.as_deref().map_or(is_told, |path| !is_none(path)) {
        if args.names.is_some() {
            let text = "--names names the segments of a robot's map, and there is none: give --valetudo FILE or mqtt, or leave --names out";
            return Err(Failure::usage(text));
        }
        if home_assistant.is_none() {
            return Err(no_rooms());
        }
    }
    let persons = home_assistant.as_ref().map_or(&[][..], |(_, home)| &home.persons);
    let residents = find_residents(args, persons, asker, &mut notes)?;
    if let Some((source, home)) = &mut home_assistant
        && residents.iter().any(|name| !home.persons.contains(name))
    {
        // Sensors have names of residents who are not persons in Home Assistant.
        *home = read_home(args, source, token.as_deref(), &residents)?;
    }
    let quiet = find_quiet(args, asker, &mut notes)?;
    let while_asleep = find_while_asleep(args, asker)?;
    Ok(Found { broker, seen, home_assistant, robot, valetudo, residents, quiet, while_asleep, notes })
}

pub(super) fn is_none(path: &Path) -> bool {
    path == Path::new("none")
}

fn read_home(args: &Args, source: &Path, token_file: Option<&Path>, residents: &[String]) -> Result<Home, Failure> {
    let registries =
        Registries { leave_out: &args.leave_out, residents, furnished: !args.bare, ..Registries::default() };
    home_assistant(source, "home", HomeOptions { token_file, authority: args.ca.as_deref(), registries })
}

/// Home Assistant's source and content, and the file of its token.
type FoundHome = (Option<(PathBuf, Home)>, Option<PathBuf>);

fn find_home_assistant(args: &Args, asker: &mut Asker, notes: &mut Vec<String>) -> Result<FoundHome, Failure> {
    let read = |source: &Path, token: Option<PathBuf>| -> Result<FoundHome, Failure> {
        if is_none(source) {
            return Ok((None, None));
        }
        let home = read_home(args, source, token.as_deref(), &[])?;
        Ok((Some((source.to_owned(), home)), token))
    };
    if let Some(given) = &args.home_assistant {
        return read(given, args.token_file.clone());
    }
    let found = home_folder();
    let shown = found.as_ref().map_or("none".to_owned(), |found| found.display().to_string());
    let question = "Home Assistant: its address (http://HOST:8123) or its configuration folder, or none.";
    let asked = asker.until(question, &shown, |asker, answer| {
        let source = Path::new(answer);
        let token = match &args.token_file {
            Some(given) => Some(given.clone()),
            None if is_url(source) => {
                // A mistake in the address shows at once.
                crate::home_assistant::check_address(answer).map_err(input)?;
                Some(ask_token(asker)?)
            }
            None => None,
        };
        read(source, token)
    })?;
    match (asked, found) {
        (Some(asked), _) => Ok(asked),
        (None, None) => Ok((None, None)),
        (None, Some(found)) => {
            notes.push(format!("found Home Assistant's configuration in {}", found.display()));
            read(&found, args.token_file.clone())
        }
    }
}

/// The token's file for an address. Without one, the address is asked for again.
fn ask_token(asker: &mut Asker) -> Result<PathBuf, Failure> {
    let question = "A file with a long-lived access token (in Home Assistant: your profile, Security), or none to give another address.";
    let default = if Path::new(TOKEN_FILE).exists() { TOKEN_FILE } else { "none" };
    let file = asker.until(question, default, |_, answer| match Path::new(answer) {
        none if is_none(none) => Ok(None),
        path => crate::home_assistant::read_token(path).map_err(input).map(|_| Some(path.to_owned())),
    })?;
    file.flatten().ok_or_else(|| input("an address needs a token; give another one, a folder, or none"))
}

fn home_folder() -> Option<PathBuf> {
    let own = std::env::var_os("HOME").map(|home| Path::new(&home).join(OWN_FOLDER));
    let all = FOLDERS.iter().map(PathBuf::from).chain(own);
    all.into_iter().find(|folder| folder.join(".storage/core.area_registry").is_file())
}

pub(super) fn find_broker(
    args: &Args,
    asker: &mut Asker,
    notes: &mut Vec<String>,
) -> Result<(Option<Broker>, Seen), Failure> {
    let at = |address: &str| Broker {
        address: address.to_owned(),
        client: format!("roomcast-init-{}", std::process::id()),
        credentials: args.mqtt_credentials.clone().map(|path| absolute(&path)),
        authority: args.mqtt_ca.clone().map(|path| absolute(&path)),
    };
    let look = |broker: &Broker| {
        let filters = [format!("+/+{STATUS}"), "+/+/$state".to_owned(), format!("+/+{MAP}")];
        look::look(broker, &filters, LOOK, |_| false)
    };
    let told = |error: LookError| format!("{error}: {}", error.remedy());
    if args.mqtt.is_none() {
        let asked = asker.until("MQTT broker: its address, or none.", LOCAL_BROKER, |asker, answer| {
            if answer == "none" {
                return Ok((None, Seen::default()));
            }
            let mut broker = at(answer);
            // A mistake in the address shows at once.
            broker.options().map_err(|error| unusable(error.into()))?;
            asker.say(&format!("Listening there for {} s ...", LOOK.as_secs()))?;
            loop {
                match look(&broker) {
                    Ok(seen) => return Ok((Some(broker), seen)),
                    // A login may help.
                    Err(LookError::Login { .. }) => {
                        let question =
                            "The broker wants a login: a file with user name and password, a line each, or none.";
                        let file = asker.text(question, "none")?.unwrap_or_default();
                        if file == "none" {
                            return Ok((Some(broker), Seen::default()));
                        }
                        broker.credentials = Some(absolute(Path::new(&file)));
                    }
                    Err(error @ LookError::Setup(_)) => return Err(unusable(error)),
                    Err(error) => return Err(input(format!("{}; or type none", told(error)))),
                }
            }
        })?;
        if let Some(asked) = asked {
            return Ok(asked);
        }
    }
    if args.mqtt.as_deref() == Some("none") {
        return Ok((None, Seen::default()));
    }
    let broker = at(args.mqtt.as_deref().unwrap_or(LOCAL_BROKER));
    match look(&broker) {
        Ok(seen) => Ok((Some(broker), seen)),
        Err(error @ LookError::Setup(_)) => Err(unusable(error)),
        Err(error) if args.mqtt.is_none() => {
            notes.push(format!(
                "{error}: without a broker no sensor is heard and no robot is driven; where there is one, give --mqtt"
            ));
            Ok((None, Seen::default()))
        }
        // The user wants the map from the broker.
        Err(error) if args.valetudo.as_deref() == Some(Path::new("mqtt")) => Err(input(told(error))),
        Err(error) => {
            let no_robot = match args.robot {
                None => {
                    "; without it no robot is set up: give --robot PREFIX/IDENTIFIER, or run init again when the broker answers"
                }
                Some(_) => "",
            };
            notes.push(format!("{}{no_robot}", told(error)));
            Ok((Some(broker), Seen::default()))
        }
    }
}

fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

/// Refuses options that need a broker: without one they would be ignored silently.
fn of_no_broker(args: &Args, robot: bool) -> CommandResult {
    let given = [
        ("--mqtt-credentials", args.mqtt_credentials.is_some()),
        ("--mqtt-ca", args.mqtt_ca.is_some()),
        ("--robot", robot),
    ];
    let Some((option, _)) = given.into_iter().find(|(_, is_given)| *is_given) else { return Ok(()) };
    let text = format!(
        "{option} is for a home with a broker, and there is none: give --mqtt mqtt://HOST[:PORT], or leave {option} out"
    );
    Err(Failure::usage(text))
}

pub(super) fn no_rooms() -> Failure {
    let text = "nothing tells of the home's rooms: give --home-assistant FOLDER or URL, or --valetudo FILE or mqtt (docs/home.md), or write the map \
                by hand (scenes/README.md)";
    Failure::usage(text)
}

fn unusable(error: LookError) -> Failure {
    if matches!(&error, LookError::Setup(MqttError::Read { .. })) {
        let text = format!("{error}; give --mqtt-credentials and --mqtt-ca files that are there, or leave them out");
        return Failure::usage(text);
    }
    Failure::usage(error)
}

/// The topics of robots with Valetudo at the broker.
fn robots_at(seen: &Seen) -> Vec<&str> {
    let mut robots: Vec<&str> = (seen.topics.keys())
        .filter_map(|topic| topic.strip_suffix(STATUS).or_else(|| topic.strip_suffix(MAP)))
        .collect();
    robots.sort_unstable();
    robots.dedup();
    robots
}

pub(super) fn is_of_home_assistant(robot: &str) -> bool {
    robot.contains("/vacuum/")
}

/// The given robot, which may be switched off. If only others are heard, a note says so.
fn given_robot(given: &str, seen: &Seen, notes: &mut Vec<String>) -> String {
    let (given, robots) = (given.trim_end_matches('/'), robots_at(seen));
    if !robots.is_empty() && !robots.contains(&given) && !is_of_home_assistant(given) {
        notes.push(format!("nothing was heard of a robot under {given}; heard of: {}", robots.join(", ")));
    }
    given.to_owned()
}

fn find_robot(
    seen: &Seen,
    is_broker: bool,
    asker: &mut Asker,
    notes: &mut Vec<String>,
) -> Result<Option<String>, Failure> {
    let robots = robots_at(seen);
    let shown = robots.join(", ");
    let Some(first) = robots.first() else {
        if is_broker {
            asker.say("No robot speaks Valetudo at the broker.")?;
        }
        return Ok(None);
    };
    let question = match robots[..] {
        [one] => format!("A robot speaks at the broker under {one}: its topic, or none to drive no robot."),
        _ => format!("Robots speak at the broker under {shown}: which one is to be driven, or none."),
    };
    let chosen = asker.until(&question, first, |_, answer| {
        let answer = answer.trim_end_matches('/');
        if answer == "none" || robots.contains(&answer) {
            return Ok(Some(answer.to_owned()).filter(|answer| answer != "none"));
        }
        Err(input(format!("nothing was heard of a robot under {answer}; heard of: {shown}")))
    })?;
    match (chosen, &robots[..]) {
        (Some(chosen), _) => Ok(chosen),
        (None, [one]) => {
            notes.push(format!("found a robot under {one}"));
            Ok(Some((*one).to_owned()))
        }
        (None, _) => {
            let text =
                format!("there are several robots at the broker: {shown}; give one with --robot, or --robot none");
            Err(Failure::usage(text))
        }
    }
}

/// The file with the robot's map, `mqtt` or `none`.
fn find_map(
    args: &Args,
    robot: Option<&str>,
    seen: &Seen,
    asker: &mut Asker,
    notes: &mut Vec<String>,
) -> Result<Option<PathBuf>, Failure> {
    let Some(robot) = robot.filter(|robot| !seen.topics.contains_key(&format!("{robot}{MAP}"))) else {
        return Ok(args.valetudo.clone());
    };
    if args.valetudo.is_some() {
        return Ok(args.valetudo.clone());
    }
    let question = "The robot tells the broker no map: a file that http://ROBOT/api/v2/robot/state/map gives, or none.";
    let asked = asker.until(question, "none", |_, answer| {
        let path = PathBuf::from(answer);
        if is_none(&path) {
            return Ok(None);
        }
        import_map(args, &read("map", &path)?, &path)?;
        Ok(Some(path))
    })?;
    let map = asked.flatten();
    if map.is_none() {
        notes.push(format!(
            "{robot} tells the broker no map, so the rooms have no outlines; for them switch on \"map data\" in Valetudo, or give --valetudo FILE"
        ));
    }
    Ok(map)
}

/// The residents: the given ones, else the persons of Home Assistant, as a default for the question.
fn find_residents(
    args: &Args,
    known: &[String],
    asker: &mut Asker,
    notes: &mut Vec<String>,
) -> Result<Vec<String>, Failure> {
    let given = names_in(&args.resident.join(","));
    if given == ["none"] {
        return Ok(Vec::new());
    }
    if !given.is_empty() {
        checked_residents(&given)?;
        return Ok(given);
    }
    // A comma would split one name into two.
    let known = if known.iter().any(|name| name.contains(',')) { &[][..] } else { known };
    let question = "Who lives here: names with commas between, or none. With names, everybody else is a visitor.";
    let shown = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
    let asked = asker.until(question, &shown, |_, answer| {
        let names = names_in(answer);
        if names == ["none"] {
            return Ok(Vec::new());
        }
        checked_residents(&names)?;
        Ok(names)
    })?;
    if asked.is_some() || known.is_empty() {
        return Ok(asked.unwrap_or_default());
    }
    let names = names_in(&shown);
    if let Err(failure) = checked_residents(&names) {
        notes.push(format!("Home Assistant's persons are no residents: {failure}; or give --resident"));
        return Ok(Vec::new());
    }
    notes.push(format!("found Home Assistant's persons, who live here: {shown}; --resident says otherwise"));
    Ok(names)
}

/// The given quiet hours, else the night.
fn find_quiet(args: &Args, asker: &mut Asker, notes: &mut Vec<String>) -> Result<Vec<QuietHours>, Failure> {
    let read = |text: &str| -> Result<Vec<QuietHours>, Failure> {
        let parts = text.split(';').map(str::trim).filter(|part| !part.is_empty() && *part != "none");
        parts.map(|part| QuietHours::try_from(part.to_owned()).map_err(Failure::usage)).collect()
    };
    if !args.quiet.is_empty() {
        return read(&args.quiet.join(";"));
    }
    let question = "Quiet hours, in which no robot works: such as 22:00-07:00; sat,sun 22:00-09:00, or none.";
    let asked = asker.until(question, QUIET, |_, answer| read(answer))?;
    asked.map_or_else(
        || {
            notes.push(format!("no robot works at {QUIET}; --quiet says otherwise"));
            read(QUIET)
        },
        Ok,
    )
}

fn find_while_asleep(args: &Args, asker: &mut Asker) -> Result<WhileAsleep, Failure> {
    if let Some(given) = args.while_asleep {
        return Ok(given);
    }
    let words = WhileAsleep::VARIANTS.iter().map(WhileAsleep::to_string).collect::<Vec<_>>().join(", ");
    let question = format!(
        "While a person sleeps, no robot works in: the sleeper's room, those beside it, the floor, the house ({words})."
    );
    let asked = asker.until(&question, &WhileAsleep::default().to_string(), |_, answer| {
        answer.parse().map_err(|_| input(format!("{answer} is none of {words}")))
    })?;
    Ok(asked.unwrap_or_default())
}

fn names_in(text: &str) -> Vec<String> {
    text.split(',').map(str::trim).filter(|name| !name.is_empty()).map(str::to_owned).collect()
}

fn checked_residents(names: &[String]) -> CommandResult {
    if names.iter().any(|name| name == "none") {
        return Err(Failure::usage("none means nobody and stands alone: give names, or none"));
    }
    let mut config = Config::default();
    config.persons.residents = names.to_vec();
    Ok(config.check()?)
}
