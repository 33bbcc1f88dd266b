//! Names as machines write them ("washingmachine", "coffe_maker") and the words a language model knows for them.
//!
//! One table for the whole product, `names.toml` beside this file: `[words]` maps a name to its words, `[aliases]` maps
//! words to other words under which a map may list the same thing, `[rooms]` and
//! `[things]` map kinds of rooms and things to their names in other languages.

use std::collections::BTreeMap;
use std::sync::LazyLock;

static BUILT_IN: LazyLock<Names> = LazyLock::new(|| {
    #[expect(clippy::expect_used, reason = "the table is compiled in and a test parses it")]
    Names::from_toml(include_str!("names.toml")).expect("names.toml is valid")
});

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
    /// As `rooms`, of things.
    #[serde(default, deserialize_with = "by_name")]
    things: BTreeMap<String, String>,
}

/// Kinds by their names, with accents left out.
fn by_name<'de, D: serde::Deserializer<'de>>(from: D) -> Result<BTreeMap<String, String>, D::Error> {
    let kinds: BTreeMap<String, Vec<String>> = serde::Deserialize::deserialize(from)?;
    let names = kinds.iter().flat_map(|(kind, names)| names.iter().map(|name| (bare(name), plain_words(kind))));
    Ok(names.collect())
}

/// Plain words without the accents of Latin letters.
fn bare(text: &str) -> String {
    let mut bare = String::with_capacity(text.len());
    for character in plain_words(text).chars() {
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
        let Self { words, aliases, rooms, things } = toml::from_str(text)?;
        let plain = |text: &str| plain_words(text);
        Ok(Self {
            words: words.iter().map(|(name, words)| (name.to_lowercase(), plain(words))).collect(),
            aliases: aliases
                .iter()
                .map(|(words, others)| (plain(words), others.iter().map(|other| plain(other)).collect()))
                .collect(),
            rooms,
            things,
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

    /// The kind of room that a name in another language means: "Küche", "KUCHE" and "Küche 2" are a kitchen, and so is "Küche unten".
    /// None where the table knows neither the name nor a word of it.
    #[must_use]
    pub fn room(&self, name: &str) -> Option<&str> {
        let bare = bare(name);
        let known = |name: &str| self.rooms.get(name).map(String::as_str);
        let numberless = bare.trim_end_matches(|character: char| character.is_ascii_digit() || character == ' ');
        known(&bare).or_else(|| known(numberless)).or_else(|| bare.split(' ').find_map(known))
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

    /// Whether these words, in lower case, name a thing of the table.
    pub(crate) fn knows(&self, words: &str) -> bool {
        self.words.contains_key(words) || self.aliases.contains_key(words)
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
    fn an_unknown_table_is_refused() {
        assert!(Names::from_toml("[word]\na = 'b'").is_err());
    }
}
