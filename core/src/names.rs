//! Names as machines write them ("washingmachine", "coffe_maker"), and the words that a language model knows for them.
//!
//! One table for the whole product, `names.toml` next to this file: `[words]` maps a name to its words, `[aliases]` maps words to other words for the
//! same thing in a map, `[rooms]` and `[things]` map kinds of rooms and things to their names in other languages, `[english_rooms]` kinds of rooms to
//! other English words, and `[entities]` has words from the names of a smart home's entities. `room_names.toml` has the names of rooms by language.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;

static BUILT_IN: LazyLock<Names> = LazyLock::new(|| {
    #[expect(clippy::expect_used, reason = "the tables are compiled in and a test parses them")]
    Names::from_toml(include_str!("names.toml"))
        .and_then(|names| names.with_rooms(include_str!("room_names.toml")))
        .expect("names.toml and room_names.toml are valid")
});

/// Most words of a name in the table.
const RUN_MAX: usize = 4;
/// Most letters of a word that are searched for parts.
const NAME_LETTERS_MAX: usize = 64;

/// Whether a letter is of a script that writes words together: Chinese, Japanese, Korean, Thai.
fn is_unspaced(letter: char) -> bool {
    matches!(letter, '\u{e00}'..='\u{e7f}' | '\u{3040}'..='\u{30ff}' | '\u{3400}'..='\u{9fff}' | '\u{ac00}'..='\u{d7a3}')
}

/// The table of names. See [`Names::built_in`].
#[derive(Debug, Clone, PartialEq, Default, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Names {
    #[serde(default)]
    words: BTreeMap<String, String>,
    #[serde(default)]
    aliases: BTreeMap<String, Vec<String>>,
    /// By name; the file has them by kind.
    #[serde(default, deserialize_with = "by_name")]
    rooms: BTreeMap<String, String>,
    /// As `rooms`, for other English words.
    #[serde(default, deserialize_with = "by_name")]
    english_rooms: BTreeMap<String, String>,
    /// As `rooms`, for things.
    #[serde(default, deserialize_with = "by_name")]
    things: BTreeMap<String, String>,
    #[serde(default)]
    entities: EntityWords,
}

/// Words in the names of a smart home's entities, in the form of [`bare`].
#[derive(Debug, Clone, PartialEq, Default, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct EntityWords {
    /// Ends of compounds for a sensor or a part of a thing.
    #[serde(deserialize_with = "set_of_bare")]
    ends: BTreeSet<String>,
    /// English words that select one of several things.
    #[serde(deserialize_with = "set_of_bare")]
    which: BTreeSet<String>,
    /// English words that distinguish lamps.
    #[serde(deserialize_with = "set_of_bare")]
    lamps: BTreeSet<String>,
    /// Things, other than doors, that a door sensor or a lock can belong to, in English.
    #[serde(deserialize_with = "set_of_bare")]
    opened: BTreeSet<String>,
    /// Names of areas that are not rooms.
    #[serde(deserialize_with = "set_of_bare")]
    no_rooms: BTreeSet<String>,
    /// Words of settings, counters and alarms.
    #[serde(deserialize_with = "set_of_bare")]
    settings: BTreeSet<String>,
    /// Words for animals, vehicles and parcels that cameras see.
    #[serde(deserialize_with = "set_of_bare")]
    creatures: BTreeSet<String>,
    /// Words by kind of thing; the file has them by kind.
    #[serde(deserialize_with = "by_name")]
    nouns: BTreeMap<String, String>,
}

impl EntityWords {
    pub(crate) fn is_lamp(&self, word: &str) -> bool {
        self.lamps.contains(word)
    }

    pub(crate) fn is_opened(&self, thing: &str) -> bool {
        self.opened.contains(thing)
    }

    pub(crate) fn is_setting(&self, word: &str) -> bool {
        self.settings.contains(word)
    }

    pub(crate) fn is_creature(&self, word: &str) -> bool {
        self.creatures.contains(word)
    }

    /// Whether a bare word, or the end of a compound, is a word for this kind of thing: "lamp" for "deckenlampe".
    pub(crate) fn is_noun(&self, word: &str, kind: &str) -> bool {
        let is_end = |end: &str| self.ends.contains(end) && self.nouns.get(end).is_some_and(|own| own == kind);
        let end = || self.stem(word).is_some_and(|stem| is_end(&word[stem.len()..]));
        self.nouns.get(word).is_some_and(|own| own == kind) || end()
    }

    pub(crate) fn is_which(&self, word: &str) -> bool {
        self.which.contains(word)
    }

    /// The first part of a compound: "kuhlschrank" for "kuhlschranktur". `None` if it is not a compound.
    pub(crate) fn stem<'a>(&self, word: &'a str) -> Option<&'a str> {
        const SHORTEST: usize = 3;
        let stems = self.ends.iter().filter_map(|end| word.strip_suffix(end.as_str()));
        stems.filter(|stem| stem.len() >= SHORTEST).min_by_key(|stem| stem.len())
    }
}

fn set_of_bare<'de, D: serde::Deserializer<'de>>(from: D) -> Result<BTreeSet<String>, D::Error> {
    let words: Vec<String> = serde::Deserialize::deserialize(from)?;
    Ok(words.iter().map(|word| bare(word)).collect())
}

/// Kinds by their names, with accents left out.
fn by_name<'de, D: serde::Deserializer<'de>>(from: D) -> Result<BTreeMap<String, String>, D::Error> {
    let kinds: BTreeMap<String, Vec<String>> = serde::Deserialize::deserialize(from)?;
    let names = kinds.iter().flat_map(|(kind, names)| names.iter().map(|name| (bare(name), plain_words(kind))));
    Ok(names.collect())
}

/// Plain words without accents of Latin letters, and with letters and digits only.
fn bare(text: &str) -> String {
    // Accents, and the vowel and tone signs of the scripts of India and of Thai.
    let is_part = |c: char| c.is_alphanumeric() || matches!(c, '\u{300}'..='\u{36f}' | '\u{900}'..='\u{e7f}');
    let text: String = text.chars().map(|c| if is_part(c) { c } else { ' ' }).collect();
    let mut bare = String::with_capacity(text.len());
    for character in plain_words(&text).chars() {
        match character {
            'à' | 'á' | 'â' | 'ã' | 'ä' | 'å' | 'ă' | 'ą' | 'ā' | '\u{1ea1}'..='\u{1eb7}' => bare.push('a'),
            'ç' | 'ć' | 'č' => bare.push('c'),
            'ď' | 'đ' | 'ð' => bare.push('d'),
            'è' | 'é' | 'ê' | 'ë' | 'ě' | 'ę' | 'ė' | 'ē' | '\u{1eb9}'..='\u{1ec7}' => bare.push('e'),
            'ğ' | 'ģ' => bare.push('g'),
            'ì' | 'í' | 'î' | 'ï' | 'ı' | 'ī' | 'į' | '\u{1ec9}'..='\u{1ecb}' => bare.push('i'),
            'ķ' => bare.push('k'),
            'ł' | 'ľ' | 'ĺ' | 'ļ' => bare.push('l'),
            'ñ' | 'ň' | 'ń' | 'ņ' => bare.push('n'),
            'ò' | 'ó' | 'ô' | 'õ' | 'ö' | 'ø' | 'ő' | 'ơ' | '\u{1ecd}'..='\u{1ee3}' => bare.push('o'),
            'ř' | 'ŕ' => bare.push('r'),
            'š' | 'ś' | 'ş' | 'ș' => bare.push('s'),
            'ť' | 'ţ' | 'ț' => bare.push('t'),
            'ù' | 'ú' | 'û' | 'ü' | 'ů' | 'ű' | 'ū' | 'ų' | 'ư' | '\u{1ee5}'..='\u{1ef1}' => bare.push('u'),
            'ý' | '\u{1ef3}'..='\u{1ef9}' => bare.push('y'),
            'ž' | 'ź' | 'ż' => bare.push('z'),
            'þ' => bare.push_str("th"),
            'ά' => bare.push('α'),
            'έ' => bare.push('ε'),
            'ή' => bare.push('η'),
            'ί' | 'ϊ' | 'ΐ' => bare.push('ι'),
            'ό' => bare.push('ο'),
            'ύ' | 'ϋ' => bare.push('υ'),
            'ώ' => bare.push('ω'),
            'ё' => bare.push('е'),
            'й' => bare.push('и'),
            'ß' => bare.push_str("ss"),
            'æ' => bare.push_str("ae"),
            // A combining accent in a decomposed name.
            '\u{300}'..='\u{36f}' => {}
            other => bare.push(other),
        }
    }
    bare
}

impl Names {
    /// The table that is compiled in.
    #[must_use]
    pub fn built_in() -> &'static Self {
        &BUILT_IN
    }

    /// Parses a table.
    ///
    /// # Errors
    /// If the text is not TOML or has unknown tables.
    pub(crate) fn from_toml(text: &str) -> Result<Self, toml::de::Error> {
        let Self { words, aliases, rooms, english_rooms, things, entities } = toml::from_str(text)?;
        let plain = |text: &str| plain_words(text);
        Ok(Self {
            words: words.iter().map(|(name, words)| (name.to_lowercase(), plain(words))).collect(),
            aliases: aliases
                .iter()
                .map(|(words, others)| (plain(words), others.iter().map(|other| plain(other)).collect()))
                .collect(),
            rooms,
            english_rooms,
            things,
            entities,
        })
    }

    fn with_rooms(mut self, text: &str) -> Result<Self, toml::de::Error> {
        let languages: BTreeMap<String, BTreeMap<String, Vec<String>>> = toml::from_str(text)?;
        for (kind, names) in languages.values().flatten() {
            self.rooms.extend(names.iter().map(|name| (bare(name), plain_words(kind))));
        }
        Ok(self)
    }

    /// Whether an area with this name is not a room: the whole house, a car, a network.
    pub(crate) fn is_no_room(&self, name: &str) -> bool {
        self.entities.no_rooms.contains(&bare(name))
    }

    /// The words of a thing by its name in another language, or by another common name ("washer").
    #[must_use]
    pub(crate) fn thing(&self, name: &str) -> Option<&str> {
        self.things.get(&bare(name)).map(String::as_str)
    }

    /// Plain words without accents of Latin letters, for comparing names of rooms and things.
    #[must_use]
    pub(crate) fn bare(text: &str) -> String {
        bare(text)
    }

    /// The plain form of a name, with one form for each spelling of an umlaut: "Küche", "kuche" and "Kueche" are equal.
    #[must_use]
    pub fn folded(text: &str) -> String {
        [("ae", "a"), ("oe", "o"), ("ue", "u")].iter().fold(bare(text), |text, (two, one)| text.replace(two, one))
    }

    pub(crate) fn entities(&self) -> &EntityWords {
        &self.entities
    }

    /// The kind of room for a name in another language: "Küche", "KUCHE" and "Küche 2" are a kitchen, and so are "Küche unten" and "Wohnküche". The
    /// longest known run of words counts, the first of equal ones; else the end of a compound, else a part of a word in a script without spaces
    /// ("主卧室"). `None` if the name is unknown, or if more of its words are English ("man cave").
    #[must_use]
    pub fn room(&self, name: &str) -> Option<&str> {
        let bare = bare(name);
        let words: Vec<&str> = bare.split(' ').filter(|word| !word.is_empty()).collect();
        for count in (1..=words.len().min(RUN_MAX)).rev() {
            let mut runs = words.windows(count).map(|run| run.join(" "));
            if let Some(kind) = runs.clone().find_map(|run| self.rooms.get(&run)) {
                return Some(kind);
            }
            if runs.any(|run| self.english_rooms.contains_key(&run)) {
                return None;
            }
        }
        let compound = words.iter().find_map(|word| self.compound(word));
        compound.or_else(|| words.iter().find_map(|word| self.part(word)))
    }

    /// The kind of room if the whole name is a room in another language: "Küche" is a kitchen. `None` for a longer name, which may mean another room
    /// of the kind ("Küche oben", "Gästebad").
    #[must_use]
    pub(crate) fn room_itself(&self, name: &str) -> Option<&str> {
        self.rooms.get(&bare(name)).map(String::as_str)
    }

    /// As [`Names::room`], including English: "Master Bedroom 2" and "Lena's bedroom" are a bedroom. In English the kind comes last, so the last of
    /// equally long runs counts.
    #[must_use]
    pub fn kind_of_room(&self, name: &str) -> Option<&str> {
        let bare = bare(name);
        let words: Vec<&str> = bare.split(' ').filter(|word| !word.is_empty()).collect();
        let known = |run: &[&str]| self.english_rooms.get(&run.join(" ")).map(String::as_str);
        let runs = (1..=words.len().min(RUN_MAX)).rev().flat_map(|count| words.windows(count).rev());
        runs.filter_map(known).next().or_else(|| self.room(name))
    }

    /// The kind of room that ends a compound: "gästebad", "elternschlafzimmer".
    fn compound(&self, word: &str) -> Option<&str> {
        const SHORTEST: usize = 5;
        /// Shorter words that end compounds all the same.
        const SHORT: [&str; 3] = ["bad", "flur", "wc"];
        const STEM: usize = 2;
        /// Words for any room, which end the names of all kinds ("Musikzimmer").
        const ANY: [&str; 3] = ["zimmer", "kamer", "szoba"];
        let ends = word.char_indices().map(|(at, _)| &word[at..]).skip(STEM);
        let mut ends =
            ends.filter(|end| end.chars().count() >= SHORTEST || SHORT.contains(end)).filter(|end| !ANY.contains(end));
        ends.find_map(|end| self.rooms.get(end)).map(String::as_str)
    }

    /// The kind of room by the longest known part of a word in a script without spaces; the last of equally long parts.
    fn part(&self, word: &str) -> Option<&str> {
        const SHORTEST: usize = 2;
        const LONGEST: usize = 16;
        let letters: Vec<char> = word.chars().take(NAME_LETTERS_MAX).collect();
        if !letters.iter().any(|letter| is_unspaced(*letter)) {
            return None;
        }
        let parts = (SHORTEST..=letters.len().min(LONGEST)).rev().flat_map(|count| letters.windows(count).rev());
        let names = parts.map(|part| part.iter().collect::<String>());
        names.filter_map(|name| self.rooms.get(&name)).next().map(String::as_str)
    }

    /// The words of a name: "washingmachine" and "Washing_Machine" are "washing machine".
    #[must_use]
    pub fn words(&self, name: &str) -> String {
        let lower = name.trim().to_lowercase();
        let plain = plain_words(&lower);
        let joined = || plain.replace(' ', "_");
        self.words
            .get(&lower)
            .or_else(|| self.words.get(&plain))
            .or_else(|| self.words.get(&joined()))
            .cloned()
            .unwrap_or(plain)
    }

    /// Every name in the table.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.words.keys().chain(self.aliases.keys()).map(String::as_str)
    }

    /// Other words for the same thing in a map, the best first. Aliases are directed (a "mug" can stand for a "cup") and not transitive.
    pub fn aliases<'a>(&'a self, words: &str) -> impl Iterator<Item = &'a str> + use<'a> {
        self.aliases.get(words).into_iter().flatten().map(String::as_str)
    }
}

/// Lower case, with single spaces in place of underscores, hyphens or white space.
pub(crate) fn plain_words(text: &str) -> String {
    let spaced = text.to_lowercase().replace(['_', '-'], " ");
    spaced.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_built_in_table_is_read() {
        assert_eq!(Names::built_in().words("washingmachine"), "washing machine");
        assert_eq!(Names::built_in().words("light_switch"), "light switch");
    }

    #[test]
    fn aliases_are_directed_and_in_order() {
        let names = Names::from_toml("[aliases]\ncup = ['mug', 'water_glass']").unwrap();
        assert_eq!(names.aliases("cup").collect::<Vec<_>>(), ["mug", "water glass"]);
        assert_eq!(names.aliases("mug").count(), 0);
    }

    #[test]
    fn rooms_are_known_in_other_languages() {
        let room = |name: &str| Names::built_in().room(name);
        for name in ["Küche", "kuche", "KÜCHE 2", "Ku\u{308}che", "Küche oben", "Cuisine", "кухня", "厨房"] {
            assert_eq!(room(name), Some("kitchen"), "{name}");
        }
        assert_eq!(room("Flur "), Some("hallway"));
        assert_eq!(room("Gäste-WC"), Some("toilet room"));
        assert_eq!(room("salle de bain"), Some("bathroom"), "the whole name before a word of it");
        assert_eq!((room("Kitchen"), room("Zaphod"), room("")), (None, None, None));
    }

    #[test]
    fn rooms_are_known_within_names_and_compounds() {
        let room = |name: &str| Names::built_in().room(name);
        for (name, kind) in [
            ("Bad (OG)", "bathroom"),
            ("🛁 Gästebad", "bathroom"),
            ("Wohn-/Esszimmer", "living room"),
            ("Elternschlafzimmer", "bedroom"),
            ("Zimmer Lena", "bedroom"),
            ("Salle de bain (étage)", "bathroom"),
            ("Chambre d'amis", "bedroom"),
            ("Chambre d’enfant Léa", "children's bedroom"),
            ("Habitación de Lucas", "bedroom"),
            ("Baño principal", "bathroom"),
            ("Pokój Kasi", "bedroom"),
            ("Pokój dzienny", "living room"),
            ("Łazienka na górze", "bathroom"),
            ("Slaapkamer ouders", "bedroom"),
            ("Gang beneden", "hallway"),
            ("Overloop", "hallway"),
            ("Camera matrimoniale", "bedroom"),
            ("Bagno di servizio", "bathroom"),
            ("Спальня родителей", "bedroom"),
            ("Ванная комната", "bathroom"),
            ("Treppenhaus", "hallway"),
            ("Garten", "garden"),
            ("ห้องครัว", "kitchen"),
            ("غرفة النوم", "bedroom"),
            ("phòng khách", "living room"),
        ] {
            assert_eq!(room(name), Some(kind), "{name}");
        }
        for unknown in ["Zaphod", "Lab", "abad", "Raum 3", "Man cave", "Kitchen upstairs"] {
            assert_eq!(room(unknown), None, "{unknown}");
        }
    }

    /// Within a language a name must not have two kinds: its kind would be arbitrary.
    #[test]
    fn a_rooms_name_has_one_kind_in_all_languages() {
        type Kinds = BTreeMap<String, Vec<String>>;
        let languages: BTreeMap<String, Kinds> = toml::from_str(include_str!("room_names.toml")).unwrap();
        assert!(languages.len() >= 40);
        let mut others: BTreeMap<String, toml::Value> = toml::from_str(include_str!("names.toml")).unwrap();
        let others: Kinds = others.remove("rooms").unwrap().try_into().unwrap();
        let mut kind_of: BTreeMap<String, String> = BTreeMap::new();
        for (kind, names) in languages.values().flatten().chain(&others) {
            for name in names {
                let known = kind_of.entry(bare(name)).or_insert_with(|| kind.clone());
                assert_eq!(known, kind, "{name}");
                assert_eq!(Names::built_in().room(name), Some(kind.as_str()), "{name}");
            }
        }
    }

    #[test]
    fn rooms_are_known_in_many_languages() {
        for (name, kind) in [
            ("Всекидневна", "living room"),
            ("Хол", "living room"),
            ("Dnevni boravak", "living room"),
            ("Kupaonica", "bathroom"),
            ("Eldhús", "kitchen"),
            ("Virtuvė", "kitchen"),
            ("Guļamistaba", "bedroom"),
            ("Magamistuba", "bedroom"),
            ("Predsoba", "entrance hall"),
            ("ΚΟΥΖΙΝΑ", "kitchen"),
            ("Yatak Odası", "bedroom"),
            ("Lastetuba", "children's bedroom"),
            ("寝室2", "bedroom"),
            ("主卧室", "bedroom"),
            ("二楼浴室", "bathroom"),
            ("ห้องน้ำชั้นล่าง", "bathroom"),
            ("아이방", "children's bedroom"),
            ("Pho\u{300}ng ngu\u{309}", "bedroom"),
            ("Ванна кімната", "bathroom"),
            ("Ruang Keluarga", "living room"),
            ("Badet oppe", "bathroom"),
            ("Kontoret", "home office"),
        ] {
            assert_eq!(Names::built_in().room(name), Some(kind), "{name}");
        }
        assert_eq!(Names::built_in().room("Musikzimmer"), None, "a room of any kind");
    }

    #[test]
    fn kinds_of_rooms_are_known_in_english() {
        let kind = |name: &str| Names::built_in().kind_of_room(name);
        for (name, expected) in [
            ("Kitchen", "kitchen"),
            ("Bedroom 2", "bedroom"),
            ("Lena's bedroom", "bedroom"),
            ("Master Bath", "bathroom"),
            ("Master bedroom bathroom", "bathroom"),
            ("Upstairs Hallway", "hallway"),
            ("Kid’s Room", "children's bedroom"),
            ("Walk-in closet", "dressing room"),
            ("Lounge (back)", "living room"),
            ("Küche oben", "kitchen"),
        ] {
            assert_eq!(kind(name), Some(expected), "{name}");
        }
        assert_eq!((kind("room 7"), kind("Zaphod")), (None, None));
    }

    #[test]
    fn words_of_entities_are_told_apart() {
        let words = Names::built_in().entities();
        assert!(words.is_setting("urlaub") && words.is_setting("away") && !words.is_setting("fridge"));
        assert!(
            words.is_noun("deckenlampe", "lamp")
                && words.is_noun("fenster", "window")
                && !words.is_noun("fenster", "lamp")
        );
        assert_eq!(words.stem("kuhlschranktur"), Some("kuhlschrank"));
        assert_eq!((words.stem("tur"), words.stem("fridge")), (None, None));
        assert!(words.is_which("front"));
    }

    #[test]
    fn an_unknown_table_is_refused() {
        assert!(Names::from_toml("[word]\na = 'b'").is_err());
    }
}
