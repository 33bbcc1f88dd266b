//! What a person may be called.

use roomcast_core::narration::Said;
use roomcast_ipc::NAME_BYTES;

/// Whether a name can be a person's: it has letters or digits, fits into a message, hides nothing, and is no number.
///
/// # Errors
/// What is wrong with it, and what to do.
///
/// ```
/// use roomcast_services::person_name::check_name;
///
/// assert!(check_name("Ada").is_ok() && check_name("12").is_err() && check_name("!").is_err());
/// ```
pub fn check_name(name: &str) -> Result<(), String> {
    let name = name.trim();
    let shown: String = name.chars().take(80).collect();
    if is_number(name) {
        return Err(format!("{shown:?} is a number: give a name with a letter"));
    }
    if ["nobody", "me", "who"].contains(&name.to_lowercase().as_str()) || Said::is_pronoun(name) {
        return Err(format!("{shown:?} is no one person's name: leave it out where nobody is named"));
    }
    let hides = name.contains(roomcast_core::text::is_hidden);
    if hides || name.len() > NAME_BYTES || !name.contains(char::is_alphanumeric) {
        return Err(format!(
            "{shown:?} is no name: give at most {NAME_BYTES} bytes with a letter or digit and without control characters"
        ));
    }
    Ok(())
}

/// Whether a text is a number rather than a name, also one that no person has.
pub(crate) fn is_number(text: &str) -> bool {
    let digits = text.trim_start_matches('-');
    !digits.is_empty() && digits.chars().all(char::is_numeric)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_in_any_digits_is_no_name() {
        for number in ["7", "-3", "٣"] {
            check_name(number).unwrap_err();
        }
        check_name("R2").unwrap();
    }
}
