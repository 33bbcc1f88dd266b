//! The values of a device to which a rule applies, and the values that mean that a sensor is on.

use roomcast_core::narration::SensorKind;

/// Values that mean "on" if a rule has no condition, in lower case. So does a number above 0: a sensor may count persons.
const ON: [&str; 21] = [
    "on",
    "true",
    "yes",
    "home",
    "open",
    "opened",
    "opening",
    "occupied",
    "present",
    "presence",
    "in bed",
    "in_bed",
    "detected",
    "motion",
    "active",
    "triggered",
    "pressed",
    "connected",
    "playing",
    "running",
    "in_use",
];
const NO_STATE: [&str; 7] = ["unavailable", "unknown", "offline", "none", "null", "nan", "undefined"];
/// The value of Zigbee2MQTT's door sensors is true while the door is closed.
const CONTACT: &str = "/contact";

pub(crate) type State = Option<bool>;

#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Condition {
    /// In the form of [`comparable`].
    when: Option<String>,
    /// In the form of [`comparable`].
    unless: Vec<String>,
    above: Option<f64>,
    below: Option<f64>,
}

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ConditionKeys<'a> {
    pub(crate) when: Option<&'a str>,
    pub(crate) unless: &'a [String],
    pub(crate) above: Option<f64>,
    pub(crate) below: Option<f64>,
}

impl Condition {
    /// # Errors
    /// Keys that exclude each other, or limits without a number between them.
    pub(crate) fn new(keys: ConditionKeys<'_>) -> Result<Self, String> {
        let ConditionKeys { when, unless, above, below } = keys;
        let is_numeric = above.is_some() || below.is_some();
        if when.is_some() && !unless.is_empty() {
            return Err("when and unless exclude each other: a rule speaks of one value, or of all but some".to_owned());
        }
        if is_numeric && (when.is_some() || !unless.is_empty()) {
            return Err("above and below exclude when and unless: a rule compares numbers, or values".to_owned());
        }
        let is_finite = [above, below].into_iter().flatten().all(f64::is_finite);
        if !is_finite || above.zip(below).is_some_and(|(above, below)| above >= below) {
            return Err("above and below are numbers, and above is less than below".to_owned());
        }
        let unless = unless.iter().map(|value| comparable(value)).collect();
        Ok(Self { when: when.map(comparable), unless, above, below })
    }

    pub(crate) fn is_numeric(&self) -> bool {
        self.above.is_some() || self.below.is_some()
    }

    #[cfg_attr(not(feature = "mqtt"), allow(dead_code, reason = "only MQTT asks"))]
    pub(crate) fn excepts(&self, compared: &str) -> bool {
        self.unless.iter().any(|own| own == compared)
    }

    /// `compared` has the form of [`comparable`]. A text that is not a number meets no numeric condition.
    #[cfg_attr(not(feature = "mqtt"), allow(dead_code, reason = "only MQTT asks"))]
    pub(crate) fn holds(&self, compared: &str) -> bool {
        if self.is_numeric() {
            return compared.parse::<f64>().is_ok_and(|number| self.is_within(number));
        }
        match self.when.as_deref() {
            Some(when) => when == compared,
            // An unavailable device has none of the states that `unless` leaves.
            None => self.unless.is_empty() || !self.excepts(compared) && !NO_STATE.contains(&compared),
        }
    }

    /// Whether it compares numbers and the value of a device with a state is not a number.
    #[cfg_attr(not(feature = "mqtt"), allow(dead_code, reason = "only MQTT asks"))]
    pub(crate) fn lacks_number(&self, compared: &str) -> bool {
        self.is_numeric() && compared.parse::<f64>().is_err() && !NO_STATE.contains(&compared)
    }

    fn is_within(&self, number: f64) -> bool {
        self.above.is_none_or(|above| number > above) && self.below.is_none_or(|below| number < below)
    }

    /// The state of a sensor by a value in the form of [`comparable`]. `field` is the value's place in its message.
    ///
    /// # Errors
    /// If numbers are to be compared and the value is no number.
    pub(crate) fn state(&self, kind: SensorKind, field: Option<&str>, compared: &str) -> Result<State, String> {
        if self.when.as_deref() == Some(compared) {
            return Ok(Some(true));
        }
        if self.excepts(compared) {
            return Ok(Some(false));
        }
        // If "online" means on, "offline" is its opposite.
        let is_opposite = compared == "offline" && self.when.as_deref() == Some("online");
        if NO_STATE.contains(&compared) && !is_opposite {
            return Ok(None);
        }
        let number = compared.parse::<f64>().ok().filter(|number| number.is_finite());
        if self.is_numeric() {
            let number = number.ok_or("its value is no number, as above and below need")?;
            return Ok(Some(self.is_within(number)));
        }
        if self.when.is_some() {
            return Ok(Some(false));
        }
        if !self.unless.is_empty() {
            return Ok(Some(true));
        }
        if kind == SensorKind::Door && field.is_some_and(|field| field.ends_with(CONTACT)) {
            return Ok(Some(compared == "false"));
        }
        Ok(Some(ON.contains(&compared) || number.is_some_and(|number| number > 0.0)))
    }
}

/// The form in which rules compare a value: numbers as numbers, texts in lower case.
pub(crate) fn comparable(value: &str) -> String {
    // Longer ones are codes of tags and keys, which a float does not represent exactly.
    const DIGITS_MAX: usize = 15;
    let value = value.trim();
    let is_number = value.len() <= DIGITS_MAX
        && value.contains(|c: char| c.is_ascii_digit())
        && value.starts_with(|c: char| c.is_ascii_digit() || matches!(c, '+' | '-' | '.'));
    match value.parse::<f64>() {
        // 0 and -0 are one number.
        Ok(number) if is_number && number.is_finite() => (number + 0.0).to_string(),
        _ => value.to_lowercase(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_compare_as_numbers_and_texts_without_case() {
        let is_same = |one, other| comparable(one) == comparable(other);
        for (one, other) in [("0", "0.0"), ("0", "-0"), ("1", "+1.00"), ("0.5", ".5"), ("100", "1e2"), ("ON", "on")] {
            assert!(is_same(one, other), "{one} {other}");
        }
        assert!(is_same("GEÖFFNET", "geöffnet"));
        for (one, other) in [("0", ""), ("0", "off"), ("1", "true"), ("inf", "infinity"), ("0", "0 W")] {
            assert!(!is_same(one, other), "{one} {other}");
        }
        assert!(!is_same("9007199254740993", "9007199254740992"), "codes of tags");
    }

    fn state(keys: ConditionKeys<'_>, kind: SensorKind, field: Option<&str>, value: &str) -> Result<State, String> {
        Condition::new(keys).unwrap().state(kind, field, &comparable(value))
    }

    #[test]
    fn usual_words_of_devices_mean_on_or_no_state_and_others_mean_off() {
        let usual = |value: &str| state(ConditionKeys::default(), SensorKind::Motion, None, value).unwrap();
        for on in ["on", "ON", "true", "1", "occupied", "Detected", "home", "open", "2", "0.5", " on "] {
            assert_eq!(usual(on), Some(true), "{on}");
        }
        for off in ["off", "false", "0", "-1", "clear", "not_home", "Work", "closed", "idle", "inf"] {
            assert_eq!(usual(off), Some(false), "{off}");
        }
        for none in ["unavailable", "Unknown", "offline", "None", "null", "NaN"] {
            assert_eq!(usual(none), None, "{none}");
        }
    }

    #[test]
    fn a_condition_says_which_values_mean_on() {
        let when = |word: &'static str, value: &str| {
            let keys = ConditionKeys { when: Some(word), ..ConditionKeys::default() };
            state(keys, SensorKind::Phone, None, value).unwrap()
        };
        assert_eq!((when("home", "Home"), when("home", "Work")), (Some(true), Some(false)));
        assert_eq!((when("home", "unavailable"), when("online", "offline")), (None, Some(false)));
        assert_eq!(when("unknown", "unknown"), Some(true));
        let unless = ["0".to_owned(), "unknown".to_owned()];
        let keys = ConditionKeys { unless: &unless, ..ConditionKeys::default() };
        for (value, expected) in
            [("0.0", Some(false)), ("unknown", Some(false)), ("3", Some(true)), ("unavailable", None)]
        {
            assert_eq!(state(keys, SensorKind::Camera, None, value).unwrap(), expected, "{value}");
        }
    }

    #[test]
    fn limits_compare_numbers() {
        let keys = ConditionKeys { above: Some(15.0), below: Some(2_000.0), ..ConditionKeys::default() };
        let power = |value: &str| state(keys, SensorKind::Appliance, None, value);
        for (value, on) in [("15", false), ("15.1", true), ("1999", true), ("2000", false), ("-3", false)] {
            assert_eq!(power(value).unwrap(), Some(on), "{value}");
        }
        assert_eq!(power("unavailable").unwrap(), None);
        assert!(power("heating").unwrap_err().contains("is no number"));
        let condition = Condition::new(keys).unwrap();
        assert!(condition.holds("20") && !condition.holds("15") && !condition.holds("on"));
    }

    /// Zigbee2MQTT's `contact` is true while the magnet is near.
    #[test]
    fn a_door_contact_that_is_true_is_closed() {
        let door = |field: &str, value: &str| state(ConditionKeys::default(), SensorKind::Door, Some(field), value);
        assert_eq!((door("/contact", "true").unwrap(), door("/contact", "false").unwrap()), (Some(false), Some(true)));
        assert_eq!(door("/open", "true").unwrap(), Some(true));
    }

    #[test]
    fn conditions_that_exclude_each_other_are_refused() {
        let unless = ["off".to_owned()];
        let one = ConditionKeys::default();
        for (keys, fault) in [
            (ConditionKeys { when: Some("on"), unless: &unless, ..one }, "when and unless exclude"),
            (ConditionKeys { when: Some("on"), above: Some(1.0), ..one }, "above and below exclude"),
            (ConditionKeys { above: Some(2.0), below: Some(1.0), ..one }, "above is less than below"),
            (ConditionKeys { above: Some(f64::NAN), ..one }, "are numbers"),
        ] {
            assert!(Condition::new(keys).unwrap_err().contains(fault), "{keys:?}");
        }
    }
}
