//! Command-line parsers for choices that the library names.

use std::str::FromStr;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use roomcast_core::policy::PolicyName;
use roomcast_core::scorer::correction::{Continuation, CorrectionChoice, prior_weight};
use strum::{EnumMessage, ParseError, VariantArray};

/// Accepts the names of `T`'s variants. The help shows them with their documentation.
pub fn choice<T>() -> impl TypedValueParser<Value = T>
where
    T: Copy + EnumMessage + FromStr<Err = ParseError> + Into<&'static str> + Send + Sync + VariantArray + 'static,
{
    let shown = |&choice: &T| {
        let value = PossibleValue::new(choice.into());
        match choice.get_documentation() {
            Some(documentation) => value.help(first_sentence(documentation)),
            None => value,
        }
    };
    PossibleValuesParser::new(T::VARIANTS.iter().map(shown).collect::<Vec<_>>()).try_map(|name| name.parse::<T>())
}

/// Accepts the names of policies.
pub fn policy() -> impl TypedValueParser<Value = PolicyName> {
    PossibleValuesParser::new(PolicyName::ALL.map(PolicyName::as_str)).try_map(|name| name.parse::<PolicyName>())
}

fn first_sentence(documentation: &str) -> String {
    let line = documentation.replace('\n', " ").replace("[`Self::", "").replace("`]", "").replace('`', "");
    let end = line.find(". ").map_or(line.len(), |end| end + 1);
    line[..end].trim_end_matches('.').to_owned()
}

/// Options of the correction of scores.
#[derive(Debug, Clone, Copy, clap::Args)]
pub struct CorrectionArgs {
    /// The tokens that compete with a label's tokens after the first; by default as the model file recommends.
    #[arg(long, value_parser = choice::<Continuation>())]
    continuation: Option<Continuation>,
    /// Weight from 0 to 1 with which scores are divided by those of a blank narration; by default as the model file recommends.
    #[arg(long, value_name = "WEIGHT", value_parser = prior_weight)]
    prior: Option<f64>,
}

impl From<CorrectionArgs> for CorrectionChoice {
    fn from(CorrectionArgs { continuation, prior }: CorrectionArgs) -> Self {
        Self { continuation, prior }
    }
}

impl From<CorrectionChoice> for CorrectionArgs {
    fn from(CorrectionChoice { continuation, prior }: CorrectionChoice) -> Self {
        Self { continuation, prior }
    }
}
