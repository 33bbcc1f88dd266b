//! Names as machines write them ("washingmachine", "coffe_maker") and the words a language model knows for them.
//!
//! One table for the whole product, `names.toml` beside this file: `[words]` maps a name to its words, `[aliases]` maps
//! words to other words under which a map may list the same thing.

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
        let Self { words, aliases } = toml::from_str(text)?;
        let plain = |text: &str| plain_words(text);
        Ok(Self {
            words: words.iter().map(|(name, words)| (name.to_lowercase(), plain(words))).collect(),
            aliases: aliases
                .iter()
                .map(|(words, others)| (plain(words), others.iter().map(|other| plain(other)).collect()))
                .collect(),
        })
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
    fn an_unknown_table_is_refused() {
        assert!(Names::from_toml("[word]\na = 'b'").is_err());
    }
}
