//! A sensor's report: a device, the room it sees, and its state. No person reads it; the filter of `tracker/` weighs it.

use std::fmt;

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString};

use super::RoomName;
use crate::text::is_hidden;

/// Longest id of a sensor, in bytes.
pub const SENSOR_ID_BYTES_MAX: usize = 128;

/// What kind of device a sensor is. It chooses the default rates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, EnumString, Display, Serialize, Deserialize)]
#[strum(serialize_all = "kebab-case")]
#[serde(rename_all = "kebab-case")]
pub enum SensorKind {
    /// A motion sensor (PIR): sees people who move, stays on for a hold time.
    Motion,
    /// A presence sensor (mmWave): sees people who sit still.
    Presence,
    /// A bed or seat sensor.
    Bed,
    /// A contact at a door between two rooms, or between a room and the outside. It is on while the door is open.
    Door,
    /// A phone: on while it is in the home's network.
    Phone,
    /// An appliance or a plug above a threshold of power.
    Appliance,
    /// A camera that detects persons.
    Camera,
}

/// The state of a sensor, and what the filter needs to know of the device. The person of a bed or a phone is the person of the event.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorReport {
    /// The kind of device.
    #[serde(rename = "sensor")]
    pub kind: SensorKind,
    /// The device, the same in each report.
    pub id: Box<str>,
    /// The room that it sees; of a door, the room inside.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub room: Option<RoomName>,
    /// Of a door between rooms, the other room.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub beyond: Option<RoomName>,
    /// Its state; `None` if the device is unavailable.
    #[serde(default)]
    pub on: Option<bool>,
    /// The time that it stays on after its person left, in seconds; the kind's default if `None`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hold_s: Option<f64>,
    /// False alarms per day; the kind's default if `None`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub false_alarms_per_day: Option<f64>,
    /// The device reports no "off": it is off after its hold time.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub only_on: bool,
}

// The numbers are finite: `check` says so.
impl Eq for SensorReport {}

impl SensorReport {
    /// Reads the JSON object that [`fmt::Display`] writes.
    ///
    /// # Errors
    /// The fault in words.
    pub fn parse(text: &str) -> Result<Self, String> {
        let own: Self = serde_json::from_str(text).map_err(|error| crate::parsing::json_of_one_line_says(&error))?;
        own.check()?;
        Ok(own)
    }

    /// Checks the keys against each other and against their limits.
    ///
    /// # Errors
    /// The key and its allowed values.
    pub fn check(&self) -> Result<(), String> {
        let is_id = self.id.contains(char::is_alphanumeric) && !self.id.contains(is_hidden);
        if !is_id || self.id.len() > SENSOR_ID_BYTES_MAX {
            return Err(format!("\"id\" is no id: give a text of at most {SENSOR_ID_BYTES_MAX} bytes"));
        }
        match (self.kind, &self.room, &self.beyond) {
            (SensorKind::Phone, None, None) => {}
            (SensorKind::Phone, ..) => return Err("a phone has no \"room\": leave it out".to_owned()),
            (_, None, _) => return Err(format!("sensor \"{}\" needs the \"room\" that it sees", self.kind)),
            (SensorKind::Door, Some(room), Some(beyond)) if room == beyond => {
                return Err("\"beyond\" is the \"room\" itself: give the room on the other side".to_owned());
            }
            (SensorKind::Door, ..) | (_, _, None) => {}
            (_, _, Some(_)) => return Err("\"beyond\" goes with sensor \"door\" alone".to_owned()),
        }
        for (key, value, most) in
            [("hold_s", self.hold_s, 86_400.0), ("false_alarms_per_day", self.false_alarms_per_day, 10_000.0)]
        {
            if value.is_some_and(|value| !(0.0..=most).contains(&value)) {
                return Err(format!("\"{key}\" is out of range: give 0 to {most}"));
            }
        }
        Ok(())
    }
}

impl fmt::Display for SensorReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&serde_json::to_string(self).map_err(|_| fmt::Error)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reports_are_read_as_they_are_written_and_faults_name_their_key() {
        for text in [
            r#"{"sensor":"motion","id":"hall","room":"hall","on":true}"#,
            r#"{"sensor":"door","id":"d","room":"hall","beyond":"porch","on":null}"#,
            r#"{"sensor":"phone","id":"p","on":false}"#,
            r#"{"sensor":"appliance","id":"kettle","room":"kitchen","on":true,"hold_s":60.0,"only_on":true}"#,
        ] {
            assert_eq!(SensorReport::parse(text).unwrap().to_string(), text);
        }
        for (text, fault) in [
            (r#"{"sensor":"radar","id":"a","room":"hall","on":true}"#, "radar"),
            (r#"{"sensor":"motion","id":" ","room":"hall","on":true}"#, "id"),
            (r#"{"sensor":"motion","id":"a","on":true}"#, "room"),
            (r#"{"sensor":"bed","id":"a","room":"b","beyond":"c"}"#, "beyond"),
            (r#"{"sensor":"door","id":"a","room":"b","beyond":"b"}"#, "\"beyond\" is the \"room\""),
            (r#"{"sensor":"phone","id":"a","room":"b"}"#, "room"),
            (r#"{"sensor":"motion","id":"a","room":"b","hold_s":-1}"#, "hold_s"),
            (r#"{"sensor":"motion","id":"a","room":"b","false_alarms_per_day":1e9}"#, "false_alarms_per_day"),
            (r#"{"sensor":"motion","id":"a","room":"b","value":1}"#, "value"),
        ] {
            let error = SensorReport::parse(text).unwrap_err();
            assert!(error.contains(fault), "{text}: {error}");
        }
    }
}
