//! The state of a sensor, as a narrator reports it.

use serde::Serialize;

use crate::IpcError;

/// Longest id of a sensor, in bytes.
pub const SENSOR_ID_BYTES_MAX: usize = 128;

/// The kind of a sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum SensorKind {
    /// A motion sensor: sees people who move.
    Motion,
    /// A presence sensor: sees people who sit still.
    Presence,
    /// A sensor of a bed or a seat.
    Bed,
    /// A contact at a door. It is on while the door is open.
    Door,
    /// A phone. It is on while it is in the home's network.
    Phone,
    /// An appliance or a plug above a threshold of power.
    Appliance,
    /// A camera that detects persons.
    Camera,
}

/// The state of a sensor: [`Narrator::sensor`](crate::Narrator::sensor).
///
/// ```
/// use roomcast_ipc::{Sensor, SensorKind};
///
/// let motion = Sensor { room: Some("hall"), on: Some(true), ..Sensor::new(SensorKind::Motion, "hall-motion") };
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Sensor<'a> {
    /// The kind of the sensor.
    #[serde(rename = "sensor")]
    pub kind: SensorKind,
    /// The device, the same in each report.
    pub id: &'a str,
    /// The room that the sensor sees; of a door, the room inside. A phone has none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub room: Option<&'a str>,
    /// The other room of a door between two rooms.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub beyond: Option<&'a str>,
    /// Whether the sensor is on; `None` if the device is unavailable.
    pub on: Option<bool>,
    /// The time that the sensor stays on after its person left, in seconds; `None` for the default of the kind.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hold_s: Option<f64>,
    /// False alarms per day; `None` for the default of the kind.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub false_alarms_per_day: Option<f64>,
    /// Whether the device reports no "off". It is off after its hold time.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub only_on: bool,
}

impl<'a> Sensor<'a> {
    /// An unavailable sensor without a room.
    #[must_use]
    pub const fn new(kind: SensorKind, id: &'a str) -> Self {
        Self { kind, id, room: None, beyond: None, on: None, hold_s: None, false_alarms_per_day: None, only_on: false }
    }

    pub(crate) fn text(&self) -> Result<String, IpcError> {
        let refused = |problem: &str| Err(IpcError::Argument(format!("sensor {:?}: {problem}", self.id)));
        if self.id.len() > SENSOR_ID_BYTES_MAX || !self.id.contains(char::is_alphanumeric) {
            return refused("give an id of at most 128 bytes with a letter or digit");
        }
        if self.room.is_none() != (self.kind == SensorKind::Phone) {
            return refused("give the room that the sensor sees, and none for a phone");
        }
        if self.beyond.is_some() && self.kind != SensorKind::Door {
            return refused("give beyond for a door alone");
        }
        if [self.room, self.beyond].into_iter().flatten().any(|room| !room.contains(char::is_alphanumeric)) {
            return refused("give a room's name");
        }
        if self.hold_s.is_some_and(|hold_s| !(0.0..=86_400.0).contains(&hold_s)) {
            return refused("hold_s is from 0 to 86400");
        }
        if self.false_alarms_per_day.is_some_and(|alarms| !(0.0..=10_000.0).contains(&alarms)) {
            return refused("false_alarms_per_day is from 0 to 10000");
        }
        if self.only_on && self.on != Some(true) {
            return refused("a sensor with only_on reports that it is on");
        }
        serde_json::to_string(self).map_err(|error| IpcError::Argument(error.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sensor_is_written_with_the_keys_that_it_has() {
        let motion = Sensor { room: Some("hall"), on: Some(true), ..Sensor::new(SensorKind::Motion, "m") };
        assert_eq!(motion.text().unwrap(), r#"{"sensor":"motion","id":"m","room":"hall","on":true}"#);
        let phone = Sensor { hold_s: Some(60.0), ..Sensor::new(SensorKind::Phone, "p") };
        assert_eq!(phone.text().unwrap(), r#"{"sensor":"phone","id":"p","on":null,"hold_s":60.0}"#);
    }

    #[test]
    fn a_sensor_with_keys_that_do_not_fit_its_kind_is_refused() {
        let motion = Sensor { room: Some("hall"), on: Some(true), ..Sensor::new(SensorKind::Motion, "m") };
        for wrong in [
            Sensor { id: "?", ..motion },
            Sensor { room: None, ..motion },
            Sensor { kind: SensorKind::Phone, ..motion },
            Sensor { beyond: Some("porch"), ..motion },
            Sensor { room: Some(" "), ..motion },
            Sensor { hold_s: Some(-1.0), ..motion },
            Sensor { false_alarms_per_day: Some(f64::NAN), ..motion },
            Sensor { on: None, only_on: true, ..motion },
        ] {
            assert!(matches!(wrong.text(), Err(IpcError::Argument(_))), "{wrong:?}");
        }
    }
}
