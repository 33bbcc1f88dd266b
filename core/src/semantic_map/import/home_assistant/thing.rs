//! The sensor that an entity is: its kind by domain and device class, and its thing by the names that are known to be things.
//!
//! Unknown words never name a thing: they are abbreviations of rooms, words of other languages, makers and settings.

use std::collections::{HashMap, HashSet};

use super::registry::{AreaTexts, Device, Entity};
use crate::names::Names;
use crate::narration::SensorKind;

/// More words of a name are ignored.
const NAME_WORDS_MAX: usize = 16;
/// Words of the longest thing.
const THING_WORDS_MAX: usize = 4;
/// A door or window has so many words that tell it from others.
const WHICH_MAX: usize = 2;
/// Shortest word that is taken for an abbreviation of a room.
const SHORTEST: usize = 2;
/// Things that people sit or lie on, so that a sensor there says nothing about the rest of the room.
const SEATS: &str = "bed, sofa, desk, chair, armchair";
/// Things that a switch powers only in part: it switches something on them.
const FURNITURE: &str = "bed, sofa, desk, chair, armchair, wardrobe, shower, toilet, mailbox, front door, balcony door";
/// Doors that lead out of the house.
const WAYS_OUT: &str = "front door, main door, entrance door, entry door, back door, rear door, garage door";
/// Things that take power while a person uses them. Thermostats and batteries do not turn them on.
const OPERATED: &str = "kettle, coffee maker, toaster, microwave, oven, stove, air fryer, mixer, washing machine, dishwasher, \
    dryer, television, game console, iron, hair dryer, sewing machine, treadmill, exercise bike, \
    electric toothbrush";
/// Integrations of cameras that detect persons.
const CAMERAS: &str = "frigate, reolink, unifiprotect";
/// Integrations of players that only sound.
const SPEAKERS: &str = "alexa_media, bluesound, bose, heos, linkplay, mpd, music_assistant, musiccast, roon, snapcast, sonos, \
    soundtouch, squeezebox, yamaha_musiccast";

fn is_in(list: &str, word: &str) -> bool {
    list.split(", ").any(|own| own == word)
}

/// What an entity is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// On: somebody moves. Off is a timeout.
    Motion,
    /// On: somebody is there. Off: the place is empty.
    Occupancy,
    Lamp,
    Door,
    Lock,
    /// A thing that opens, and no door to a room: a window, a curtain, a garage door.
    Opened(&'static str),
    /// A cover without a class.
    Cover,
    Television,
    /// A speaker or a stereo.
    Sounding(&'static str),
    /// A player without a class.
    Player,
    Fan,
    /// A humidifier or a dehumidifier.
    Turned(&'static str),
    Climate,
    Switch,
    /// A sensor of a machine that runs or of a thing that shakes.
    Used,
    /// A meter of the power of a thing.
    Power,
    /// A meter: it names a thing and says nothing.
    Measured,
}

impl Kind {
    /// The kind by domain and device class. `None` for entities that do not report on people.
    fn of(entity: &Entity, domain: &str) -> Option<Self> {
        let kind = match (domain, entity.class()) {
            ("binary_sensor", "motion" | "moving") => Self::Motion,
            ("binary_sensor", "occupancy" | "presence") => Self::Occupancy,
            ("binary_sensor" | "cover", "door") | ("binary_sensor", "opening") => Self::Door,
            ("binary_sensor", "garage_door") | ("cover", "garage") => Self::Opened("garage door"),
            ("binary_sensor" | "cover", "window") => Self::Opened("window"),
            ("binary_sensor", "lock") | ("lock", _) => Self::Lock,
            ("binary_sensor", "running" | "power" | "plug" | "vibration") => Self::Used,
            ("light", _) => Self::Lamp,
            ("switch", _) => Self::Switch,
            ("fan", _) => Self::Fan,
            ("humidifier", "dehumidifier") => Self::Turned("dehumidifier"),
            ("humidifier", _) => Self::Turned("humidifier"),
            ("cover", "gate") => Self::Opened("gate"),
            ("cover", "curtain") => Self::Opened("curtain"),
            ("cover", "awning") => Self::Opened("awning"),
            ("cover", "damper") => return None,
            ("cover", "") => Self::Cover,
            ("cover", _) => Self::Opened("blinds"),
            ("media_player", "tv") => Self::Television,
            ("media_player", "speaker") => Self::Sounding("speaker"),
            ("media_player", "receiver") => Self::Sounding("stereo"),
            ("media_player", _) if is_in(SPEAKERS, entity.platform()) => Self::Sounding("speaker"),
            ("media_player", _) => Self::Player,
            ("climate", _) => Self::Climate,
            ("sensor", "power") => Self::Power,
            ("sensor", "energy") => Self::Measured,
            _ => return None,
        };
        Some(kind)
    }

    /// The thing by its kind alone.
    fn noun(self) -> Option<&'static str> {
        match self {
            Self::Lamp => Some("lamp"),
            Self::Door | Self::Lock => Some("door"),
            Self::Opened(noun) | Self::Sounding(noun) | Self::Turned(noun) => Some(noun),
            Self::Cover => Some("blinds"),
            Self::Television | Self::Player => Some("television"),
            Self::Fan => Some("fan"),
            Self::Climate => Some("radiator"),
            Self::Motion | Self::Occupancy | Self::Switch | Self::Used | Self::Power | Self::Measured => None,
        }
    }

    /// Whether an entity of this kind can be of a thing that its name has: only doors open fridges, and none opens a bed.
    fn may_be(self, thing: &str) -> bool {
        let one_of = |things: &str| is_in(things, thing);
        match self {
            Self::Lamp => !thing.ends_with("door") && !thing.ends_with("gate"),
            Self::Door | Self::Lock => thing.ends_with("door") || Names::built_in().entities().is_opened(thing),
            Self::Cover => one_of("blinds, curtain, awning, garage door, gate"),
            Self::Sounding(_) => one_of("speaker, radio, stereo"),
            Self::Player => one_of("television, speaker, radio, stereo, game console"),
            Self::Fan => one_of("fan, ceiling fan, exhaust fan, range hood, air purifier, heater"),
            Self::Climate => one_of("radiator, air conditioner, heater, heat pump"),
            Self::Occupancy => one_of(SEATS),
            Self::Switch | Self::Used | Self::Power | Self::Measured => {
                thing == "garage door" || !thing.ends_with("door")
            }
            _ => false,
        }
    }

    /// Whether it measures and has no state.
    pub(super) fn is_meter(self) -> bool {
        matches!(self, Self::Power | Self::Measured)
    }

    /// The states that say something, each with the verb that stands before the thing.
    pub(super) fn verbs(self, domain: &str, thing: &str) -> Vec<(&'static str, &'static str)> {
        let (on, off) = match domain {
            "cover" => ("open", "closed"),
            "lock" => ("unlocked", "locked"),
            _ => ("on", "off"),
        };
        match self {
            Self::Motion | Self::Occupancy | Self::Climate | Self::Power | Self::Measured => Vec::new(),
            Self::Used => vec![(on, "use")],
            Self::Switch if is_in(FURNITURE, thing) => vec![(on, "use")],
            Self::Lock => vec![(on, "unlock"), (off, "lock")],
            Self::Television | Self::Sounding(_) | Self::Player => match thing {
                "speaker" | "radio" | "stereo" => vec![("playing", "listen to"), ("off", "turn off")],
                "game console" => vec![("playing", "use"), ("on", "turn on"), ("off", "turn off")],
                // Many televisions tell that they are on, and no more.
                _ => vec![("playing", "watch"), ("on", "turn on"), ("off", "turn off")],
            },
            Self::Lamp | Self::Fan | Self::Turned(_) | Self::Switch => vec![(on, "turn on"), (off, "turn off")],
            _ => vec![(on, "open"), (off, "close")],
        }
    }
}

/// An entity that reports on people.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Sensor {
    pub(super) kind: Kind,
    /// The thing in plain English. `None` for a sensor of a whole room.
    pub(super) thing: Option<String>,
    /// Whether a camera sees it.
    pub(super) is_camera: bool,
}

/// Why an entity is no sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NoSensor {
    /// It does not report on people: a measurement, a setting, an animal.
    Silent,
    /// A switch or a machine with a name that is no known thing.
    Nameless,
}

impl Sensor {
    /// Whether an entity can be a sensor by its domain and class alone.
    pub(super) fn is_of(entity: &Entity, domain: &str) -> bool {
        Kind::of(entity, domain).is_some()
    }

    /// Takes an occupancy sensor of a person for one on a bed if its name has a bed. Without a person "bed" can be an abbreviation of the room.
    pub(super) fn bind(&mut self, is_of_person: bool, entity: &Entity, object: &str, device: Option<&Device>) {
        if !is_of_person || self.kind != Kind::Occupancy || self.thing.is_some() {
            return;
        }
        let names = Names::built_in();
        let is_bed = |word: &str| names.thing(word) == Some("bed");
        let has_bed = entity.names(object, device).any(|text| Names::bare(text).split(' ').any(is_bed));
        self.thing = has_bed.then(|| "bed".to_owned());
    }

    /// The kind and the thing of an entity.
    pub(super) fn of(
        entity: &Entity,
        domain: &str,
        object: &str,
        device: Option<&Device>,
        area: &AreaTexts,
    ) -> Result<Self, NoSensor> {
        let mut kind = Kind::of(entity, domain).ok_or(NoSensor::Silent)?;
        let own: Vec<Vec<String>> = entity.own_names(object).map(|text| words(text, area)).collect();
        let all = || own.iter().flatten().map(String::as_str);
        let words_of_entities = Names::built_in().entities();
        let is_silent = match kind {
            Kind::Switch | Kind::Used | Kind::Power | Kind::Measured => own.iter().any(|words| has_setting(words)),
            Kind::Lamp => all().any(|word| ["indicator", "status"].contains(&word)),
            Kind::Motion | Kind::Occupancy => all().any(|word| words_of_entities.is_creature(word)),
            _ => false,
        };
        if is_silent {
            return Err(NoSensor::Silent);
        }
        let has_noun = |noun: &str| all().any(|word| words_of_entities.is_noun(word, noun));
        let is_camera = is_in(CAMERAS, entity.platform()) || all().any(|word| ["camera", "person"].contains(&word));
        let is_garage = |word: &str| Names::built_in().kind_of_room(word) == Some("garage");
        let mut noun = kind.noun();
        match kind {
            // Few homes have blinds at a garage.
            Kind::Cover if all().chain(area.words.iter().map(String::as_str)).any(is_garage) => {
                noun = Some("garage door")
            }
            Kind::Switch if has_noun("lamp") => (kind, noun) = (Kind::Lamp, Some("lamp")),
            Kind::Used | Kind::Power | Kind::Measured if has_noun("lamp") => noun = Some("lamp"),
            Kind::Door if entity.class() == "opening" && has_noun("window") => {
                (kind, noun) = (Kind::Opened("window"), Some("window"))
            }
            _ => {}
        }
        let texts = entity.names(object, device).map(|text| words(text, area));
        let named = texts.into_iter().find_map(|words| thing_in(&words, &area.words, kind));
        let thing = named.or_else(|| noun.map(str::to_owned));
        match kind {
            Kind::Switch | Kind::Used if thing.is_none() => Err(NoSensor::Nameless),
            Kind::Power | Kind::Measured if thing.is_none() => Err(NoSensor::Silent),
            _ => Ok(Self { kind, thing, is_camera }),
        }
    }

    /// Whether it holds its state while a person is in its room.
    pub(super) fn is_of_room(&self) -> bool {
        self.kind == Kind::Occupancy && self.thing.is_none() && !self.is_camera
    }

    /// The kind of sensor for a rule. `None` for a thing that people operate, and for a door between two rooms: the registries do not have its
    /// other room. `sees_room` says that no other sensor holds the state of the room.
    pub(super) fn device(&self, sees_room: bool) -> Option<SensorKind> {
        let is_one_of = |things: &str| self.thing.as_deref().is_some_and(|thing| is_in(things, thing));
        match self.kind {
            Kind::Motion => Some(SensorKind::Motion),
            Kind::Occupancy if self.is_seat() => Some(SensorKind::Bed),
            Kind::Occupancy if self.is_camera => Some(SensorKind::Camera),
            Kind::Occupancy if sees_room => Some(SensorKind::Presence),
            // Each of several sensors sees a part of the room, so "off" says little.
            Kind::Occupancy => Some(SensorKind::Motion),
            Kind::Door | Kind::Opened(_) if is_one_of(WAYS_OUT) => Some(SensorKind::Door),
            Kind::Power if is_one_of(OPERATED) => Some(SensorKind::Appliance),
            _ => None,
        }
    }

    /// Whether it is on a bed or a seat, so that a room around it can be occupied while it is not.
    pub(super) fn is_seat(&self) -> bool {
        self.kind == Kind::Occupancy && self.thing.is_some()
    }
}

/// Whether a name has a word of settings, or two ("child lock").
fn has_setting(words: &[String]) -> bool {
    let entities = Names::built_in().entities();
    let is_setting = |run: &[String]| entities.is_setting(&run.join(" "));
    words.windows(1).any(is_setting) || words.windows(2).any(is_setting)
}

/// The words of a name in the order of the name, without numbers and without an abbreviation of the area at the front ("bed_window_1").
fn words(text: &str, area: &AreaTexts) -> Vec<String> {
    let bare = Names::bare(text);
    // A number tells one of several from the others. A Latin letter alone is the rest of an apostrophe or of markup.
    let is_none = |word: &&str| word.chars().any(|c| c.is_ascii_digit()) || word.len() < 2;
    let words: Vec<String> =
        bare.split(' ').filter(|word| !is_none(word)).take(NAME_WORDS_MAX).map(str::to_owned).collect();
    let has_area = words.iter().any(|word| area.words.contains(word));
    let is_short = |word: &String| {
        let is_start = |long: &String| long.len() > word.len() && long.starts_with(word.as_str());
        word.len() >= SHORTEST && area.long.iter().any(is_start)
    };
    let skipped = usize::from(!has_area && words.len() > 1 && words.first().is_some_and(is_short));
    words.into_iter().skip(skipped).collect()
}

/// The thing in a name such as "Fridge door sensor".
fn thing_in(words: &[String], area_words: &HashSet<String>, kind: Kind) -> Option<String> {
    let names = Names::built_in();
    let entities = names.entities();
    let known = |run: &[String]| {
        let single = <&[String; 1]>::try_from(run).ok().map(|[word]| word.as_str());
        if single.is_some_and(|word| area_words.contains(word)) {
            return None;
        }
        let stem = || names.thing(entities.stem(single?)?);
        let thing = names.thing(&run.join(" ")).or_else(stem).filter(|thing| kind.may_be(thing))?;
        // The lamp at a bed is a bed lamp.
        Some(if kind == Kind::Lamp && !thing.ends_with("lamp") { format!("{thing} lamp") } else { thing.to_owned() })
    };
    // The longest run of words counts ("apple tv").
    let mut runs = (1..=words.len().min(THING_WORDS_MAX)).rev().flat_map(|count| words.windows(count));
    if let Some(thing) = runs.find_map(known) {
        return Some(thing);
    }
    let own = words.iter().map(String::as_str).filter(|word| !area_words.contains(*word));
    match kind {
        Kind::Door | Kind::Opened("window") | Kind::Lock => {
            let which: Vec<&str> = own.filter(|word| entities.is_which(word)).take(WHICH_MAX).collect();
            let noun = kind.noun()?;
            (!which.is_empty()).then(|| format!("{} {noun}", which.join(" ")))
        }
        Kind::Lamp => own.into_iter().find(|word| entities.is_lamp(word)).map(|word| format!("{word} lamp")),
        _ => None,
    }
}

/// Persons by the first words of their names.
pub(super) struct FirstNames<'a>(HashMap<String, Option<&'a str>>);

impl<'a> FirstNames<'a> {
    /// Of persons; a name that begins another one, as "Ada" begins "Ada Lovelace", is the same person.
    pub(super) fn of(persons: &[&'a str]) -> Self {
        let mut named: HashMap<String, Option<&'a str>> = HashMap::new();
        for person in persons.iter().copied() {
            let bare = Names::bare(person);
            let first = bare.split(' ').next().unwrap_or_default().to_owned();
            let is_same = |other: &str| {
                let other = Names::bare(other);
                other == bare || other == first || bare == first
            };
            // A first name of two persons is no person's.
            let known = named.entry(first.clone()).or_insert(Some(person));
            if known.is_some_and(|own| !is_same(own)) {
                *known = None;
            }
        }
        Self(named)
    }

    /// The one person in an entity's name, if the area's name does not have the person, too: "bed_mira" in the bedroom.
    pub(super) fn person_in(
        &self,
        entity: &Entity,
        object: &str,
        device: Option<&Device>,
        area: &AreaTexts,
    ) -> Option<&'a str> {
        let mut found: Option<&'a str> = None;
        for text in entity.names(object, device) {
            for word in Names::bare(text).split(' ').filter(|word| !area.words.contains(*word)) {
                let genitive = || word.strip_suffix('s').filter(|stem| !area.words.contains(*stem));
                let named = self.0.get(word).or_else(|| self.0.get(genitive()?)).copied().flatten();
                if let Some(person) = named {
                    if found.is_some_and(|other| other != person) {
                        return None;
                    }
                    found = Some(person);
                }
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Kind::{Cover, Door, Lamp, Player, Switch, Used};

    const SPEAKER: Kind = Kind::Sounding("speaker");
    const WINDOW: Kind = Kind::Opened("window");

    #[test]
    fn things_are_named_in_plain_words() {
        let words_of = ["kuche", "kitchen", "wohnzimmer", "living", "room"].map(str::to_owned).into();
        let area = AreaTexts {
            words: words_of,
            long: vec!["kitchen".to_owned(), "bedroom".to_owned()],
            comment: String::new(),
        };
        for (text, kind, expected) in [
            ("fridge_door", Door, Some("fridge")),
            ("Kühlschranktür", Door, Some("fridge")),
            ("kitchen_ceiling", Lamp, Some("ceiling lamp")),
            ("front_door", Door, Some("front door")),
            ("back left window", WINDOW, Some("back left window")),
            ("kitchen motion", Switch, None),
            ("0x00158d0001", Door, None),
            ("Coffee maker plug 2", Switch, Some("coffee maker")),
            ("Waschmaschine Leistung", Used, Some("washing machine")),
            ("Wohnzimmer Licht Decke", Lamp, Some("ceiling lamp")),
            ("Kitchen Rollo", Cover, Some("blinds")),
            ("Garagentor", Cover, Some("garage door")),
            ("Küchenfenster links", WINDOW, None),
            ("Schlafzimmertür", Door, None),
            ("Haustür", Door, Some("front door")),
            ("Haus Licht", Lamp, None),
            ("TV Hintergrundlicht", Lamp, Some("television lamp")),
            ("Porte frigo", Door, Some("fridge")),
            ("Fenêtre de la cuisine gauche", WINDOW, None),
            ("Lumière plafond", Lamp, Some("ceiling lamp")),
            ("Puerta de la nevera", Door, Some("fridge")),
            ("Enchufe lavadora", Switch, Some("washing machine")),
            ("Koelkast deur", Door, Some("fridge")),
            ("Czujnik otwarcia lodówka", Door, Some("fridge")),
            ("Aqara MCCGQ11LM Door", Door, None),
            ("Hue color lamp 2", Lamp, None),
            ("Nest Mini", SPEAKER, Some("speaker")),
            ("Living Room Apple TV", Player, Some("television")),
            ("Холодильник", Door, Some("fridge")),
            ("LED Strip TV Board", Lamp, Some("television lamp")),
            ("Wandlampe", Lamp, None),
            ("Spiegel", Lamp, None),
            ("bed_window", WINDOW, None),
            ("bed", Door, None),
            ("kit_toaster", Switch, Some("toaster")),
            ("Компрессор", Switch, None),
            ("f", WINDOW, None),
            ("灯", Switch, None),
        ] {
            assert_eq!(thing_in(&words(text, &area), &area.words, kind).as_deref(), expected, "{text}");
        }
    }
}
