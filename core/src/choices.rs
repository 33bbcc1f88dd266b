//! Enums with one word per variant.

/// Defines enums: each variant has the same word in files, on the command line and in messages: the name in kebab case. The crate that uses it
/// depends on `serde` and `strum`.
#[macro_export]
macro_rules! choices {
    ($($choice:item)*) => {$(
        #[derive(
            Debug, Clone, Copy, PartialEq, Eq, ::serde::Serialize, ::serde::Deserialize, ::strum::Display, ::strum::EnumMessage,
            ::strum::EnumString, ::strum::IntoStaticStr, ::strum::VariantArray,
        )]
        #[serde(rename_all = "kebab-case")]
        #[strum(serialize_all = "kebab-case")]
        $choice
    )*};
}
