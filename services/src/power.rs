//! Whether the machine runs on battery, by Linux's `/sys/class/power_supply`.

use std::fs;
use std::path::Path;

/// Linux's list of batteries and chargers.
pub(crate) const SUPPLIES: &str = "/sys/class/power_supply";

/// Whether a battery of the machine itself is discharging. False without one, or if Linux does not report it.
pub(crate) fn is_on_battery(supplies: &Path) -> bool {
    let Ok(entries) = fs::read_dir(supplies) else { return false };
    entries.flatten().any(|entry| {
        let says = |what: &str| fs::read_to_string(entry.path().join(what)).unwrap_or_default();
        // A mouse or a headset has a battery with the scope "Device".
        says("type").trim() == "Battery" && says("scope").trim() != "Device" && says("status").trim() == "Discharging"
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_battery_of_the_machine_that_is_used_up_counts() {
        let folder = tempfile::tempdir().unwrap();
        let supplies = folder.path();
        let supply = |name: &str, says: &[(&str, &str)]| {
            fs::create_dir_all(supplies.join(name)).unwrap();
            says.iter()
                .for_each(|(what, text)| fs::write(supplies.join(name).join(what), format!("{text}\n")).unwrap());
        };
        assert!(!is_on_battery(&supplies.join("missing")) && !is_on_battery(supplies));
        supply("AC", &[("type", "Mains"), ("online", "1")]);
        supply("BAT0", &[("type", "Battery"), ("status", "Charging")]);
        supply("hid-mouse", &[("type", "Battery"), ("scope", "Device"), ("status", "Discharging")]);
        assert!(!is_on_battery(supplies));
        supply("BAT0", &[("status", "Discharging")]);
        assert!(is_on_battery(supplies));
    }
}
