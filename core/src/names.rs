//! Names as machines write them ("washingmachine", "coffe_maker") and the words a language model knows for them.
//!
//! One table for the whole product, `names.toml` beside this file: `[words]` maps a name to its words, `[aliases]` maps
//! words to other words under which a map may list the same thing, `[rooms]` and
//! `[things]` map kinds of rooms and things to their names in other languages, `[english_rooms]` kinds of rooms to other words of English,
//! and `[entities]` has words that a smart home's entities are named with and that name no thing.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;

static BUILT_IN: LazyLock<Names> = LazyLock::new(|| {
    #[expect(clippy::expect_used, reason = "the table is compiled in and a test parses it")]
    Names::from_toml(include_str!("names.toml")).expect("names.toml is valid")
});

/// Words of a name that are looked for together.
const RUN_MAX: usize = 4;

/// The table of names. See [`Names::built_in`].
#[derive(Debug, Clone, PartialEq, Default, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Names {
    #[serde(default)]
    words: BTreeMap<String, String>,
    #[serde(default)]
    aliases: BTreeMap<String, Vec<String>>,
    /// In the file by kind; here by name.
    #[serde(default, deserialize_with = "by_name")]
    rooms: BTreeMap<String, String>,
    /// As `rooms`, of what English calls them.
    #[serde(default, deserialize_with = "by_name")]
    english_rooms: BTreeMap<String, String>,
    /// As `rooms`, of things.
    #[serde(default, deserialize_with = "by_name")]
    things: BTreeMap<String, String>,
    #[serde(default)]
    entities: EntityWords,
}

/// Words in the names of a smart home's entities that do not name their thing. Compared as [`bare`] has them.
#[derive(Debug, Clone, PartialEq, Default, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct EntityWords {
    /// What is measured or switched, makers, and words that join others.
    #[serde(deserialize_with = "set_of_bare")]
    measured: BTreeSet<String>,
    /// Ends of compounds that say the same.
    #[serde(deserialize_with = "set_of_bare")]
    ends: BTreeSet<String>,
    /// Which of several, in English.
    #[serde(deserialize_with = "set_of_bare")]
    which: BTreeSet<String>,
}

impl EntityWords {
    /// Whether a bare word says what is measured, and not of what.
    pub(crate) fn is_measured(&self, word: &str) -> bool {
        self.measured.contains(word)
    }

    /// Whether a bare word says which door or window it is.
    pub(crate) fn is_which(&self, word: &str) -> bool {
        self.which.contains(word)
    }

    /// What a compound is of: "kuhlschrank" of "kuhlschranktur". None where it is none.
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

/// Plain words without the accents of Latin letters, and without what is neither letter nor digit.
fn bare(text: &str) -> String {
    let is_part = |c: char| c.is_alphanumeric() || ('\u{300}'..='\u{36f}').contains(&c);
    let text: String = text.chars().map(|c| if is_part(c) { c } else { ' ' }).collect();
    let mut bare = String::with_capacity(text.len());
    for character in plain_words(&text).chars() {
        match character {
            'à' | 'á' | 'â' | 'ã' | 'ä' | 'å' | 'ă' | 'ą' => bare.push('a'),
            'ç' | 'ć' | 'č' => bare.push('c'),
            'ď' => bare.push('d'),
            'è' | 'é' | 'ê' | 'ë' | 'ě' | 'ę' => bare.push('e'),
            'ì' | 'í' | 'î' | 'ï' | 'ı' => bare.push('i'),
            'ł' | 'ľ' | 'ĺ' => bare.push('l'),
            'ñ' | 'ň' | 'ń' => bare.push('n'),
            'ò' | 'ó' | 'ô' | 'õ' | 'ö' | 'ø' | 'ő' => bare.push('o'),
            'ř' | 'ŕ' => bare.push('r'),
            'š' | 'ś' | 'ş' | 'ș' => bare.push('s'),
            'ť' | 'ţ' | 'ț' => bare.push('t'),
            'ù' | 'ú' | 'û' | 'ü' | 'ů' | 'ű' => bare.push('u'),
            'ý' => bare.push('y'),
            'ž' | 'ź' | 'ż' => bare.push('z'),
            'ß' => bare.push_str("ss"),
            'æ' => bare.push_str("ae"),
            // A combining accent, as names are stored that were decomposed.
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

    /// Reads a table.
    ///
    /// # Errors
    /// When the text is not TOML or has other tables than `words` and `aliases`.
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

    /// The words of a thing by its name in another language, or by one that is common in homes ("washer").
    #[must_use]
    pub(crate) fn thing(&self, name: &str) -> Option<&str> {
        self.things.get(&bare(name)).map(String::as_str)
    }

    /// Plain words without the accents of Latin letters: how names of rooms and things are compared.
    #[must_use]
    pub(crate) fn bare(text: &str) -> String {
        bare(text)
    }

    /// Words of entities that name no thing.
    pub(crate) fn entities(&self) -> &EntityWords {
        &self.entities
    }

    /// The kind of room that a name in another language means: "Küche", "KUCHE" and "Küche 2" are a kitchen, and so are "Küche unten" and
    /// "Wohnküche". The longest run of words that the table knows counts, the first of equal ones; else the end of a compound.
    /// None where the table knows neither, and where more words are English ("man cave").
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
        words.iter().find_map(|word| self.compound(word))
    }

    /// The kind of room that a whole name is in another language: "Küche" is a kitchen. None for a name that says more, which may be that of
    /// another room of the kind ("Küche oben", "Gästebad").
    #[must_use]
    pub(crate) fn room_itself(&self, name: &str) -> Option<&str> {
        self.rooms.get(&bare(name)).map(String::as_str)
    }

    /// As [`Names::room`], of English as well: "Master Bedroom 2" and "Lena's bedroom" are a bedroom. What English calls it stands last, so the
    /// last of equally long runs counts.
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
        /// Shorter ones that do.
        const SHORT: [&str; 3] = ["bad", "flur", "wc"];
        const STEM: usize = 2;
        let ends = word.char_indices().map(|(at, _)| &word[at..]).skip(STEM);
        let mut ends = ends.filter(|end| end.chars().count() >= SHORTEST || SHORT.contains(end));
        ends.find_map(|end| self.rooms.get(end)).map(String::as_str)
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

    /// Every name that the table knows something of.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.words.keys().chain(self.aliases.keys()).map(String::as_str)
    }

    /// All words of English that the table has.
    pub(crate) fn english(&self) -> BTreeSet<&str> {
        let texts = (self.words.values().chain(self.aliases.keys()).chain(self.aliases.values().flatten()))
            .chain(self.rooms.values().chain(self.english_rooms.keys()))
            .chain(self.things.values().chain(&self.entities.which));
        texts.flat_map(|text| text.split(' ')).collect()
    }

    /// Other words under which a map may list what `words` name, the best first. They are directed: a "cup" may be served
    /// by a "mug"; and they are not followed twice.
    pub fn aliases<'a>(&'a self, words: &str) -> impl Iterator<Item = &'a str> + use<'a> {
        self.aliases.get(words).into_iter().flatten().map(String::as_str)
    }
}

/// Lower case, with single spaces where underscores, hyphens or white space stand.
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
        assert!(words.is_measured("fenster") && words.is_measured("temperature") && !words.is_measured("fridge"));
        assert_eq!(words.stem("kuhlschranktur"), Some("kuhlschrank"));
        assert_eq!((words.stem("tur"), words.stem("fridge")), (None, None));
        assert!(words.is_which("front"));
    }

    #[test]
    fn an_unknown_table_is_refused() {
        assert!(Names::from_toml("[word]\na = 'b'").is_err());
    }
}
