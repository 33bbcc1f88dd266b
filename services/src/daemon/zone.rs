//! The local time zone.

use std::ffi::OsStr;

use roomcast_core::ids::UnixNs;

/// Why the local time zone is unknown.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NoZone {
    /// The cause.
    pub reason: String,
    /// The remedy.
    pub remedy: String,
}

/// The local time zone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Zone(Option<tz::TimeZone>);

impl Zone {
    /// No time zone: local time is UTC.
    pub const UTC: Self = Self(None);

    /// The machine's time zone. If it has none, the log warns, and local time is UTC.
    #[must_use]
    pub fn local() -> Self {
        Self::find().unwrap_or_else(|NoZone { reason, remedy }| {
            tracing::warn!("{reason}; hours of the day are those of UTC: {remedy}");
            Self::UTC
        })
    }

    /// The machine's time zone, as `date` has it: the environment variable `TZ` with a name like `Europe/Berlin`, a file, or a rule like
    /// `CET-1CEST,M3.5.0,M10.5.0/3`. An empty variable is UTC, and an unset one means `/etc/localtime`.
    ///
    /// # Errors
    /// [`NoZone`] when the time zone cannot be read.
    pub fn find() -> Result<Self, NoZone> {
        Self::of_variable(std::env::var_os("TZ").as_deref())
    }

    pub(crate) fn of_variable(value: Option<&OsStr>) -> Result<Self, NoZone> {
        let Some(value) = value else {
            return tz::TimeZone::local().map(|zone| Self(Some(zone))).map_err(|error| NoZone {
                reason: format!("no time zone is set: TZ is not, and /etc/localtime cannot be read: {error}"),
                remedy: "timedatectl set-timezone Europe/Berlin, or your own, or set TZ".to_owned(),
            });
        };
        if value.is_empty() {
            return Ok(Self::UTC);
        }
        // The library itself reads no environment.
        let zone = value.to_str().and_then(|value| tz::TimeZone::from_posix_tz(value).ok());
        zone.map(|zone| Self(Some(zone))).ok_or_else(|| NoZone {
            reason: format!("TZ is {value:?}, which is no time zone of this machine"),
            remedy: "correct it, or install the package tzdata; a rule as CET-1CEST,M3.5.0,M10.5.0/3 needs none"
                .to_owned(),
        })
    }

    /// Seconds since 1970 in local time.
    #[must_use]
    pub fn local_s(&self, unix_ns: UnixNs) -> f64 {
        let unix_s = unix_ns.0 / 1_000_000_000;
        let zone = self.0.as_ref().zip(i64::try_from(unix_s).ok());
        let offset_s = zone.and_then(|(zone, unix_s)| Some(zone.find_local_time_type(unix_s).ok()?.ut_offset()));
        unix_ns.seconds() + f64::from(offset_s.unwrap_or_default())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_hour_is_a_local_one() {
        let zone = Zone::of_variable(Some(OsStr::new("CET-1CEST,M3.5.0,M10.5.0/3"))).unwrap();
        // 2024-03-31: at 1:00 UTC it becomes 3:00.
        let night_s = 1_711_846_800;
        assert_eq!(zone.local_s(UnixNs((night_s - 60) * 1_000_000_000)), (night_s - 60 + 3_600) as f64);
        assert_eq!(zone.local_s(UnixNs((night_s + 60) * 1_000_000_000)), (night_s + 60 + 7_200) as f64);
        assert_eq!(Zone::UTC.local_s(UnixNs(night_s * 1_000_000_000)), night_s as f64);
    }

    /// 06:00 UTC is 08:00 in Berlin in summer and 07:00 in winter, by name and by rule.
    #[test]
    fn the_variable_names_the_time_zone() {
        let hour = |zone: &Zone, unix_s: u64| (zone.local_s(UnixNs(unix_s * 1_000_000_000)) / 3_600.0).rem_euclid(24.0);
        let (summer, winter) = (1_784_008_800, 1_796_104_800);
        let of = |value: &str| Zone::of_variable(Some(OsStr::new(value)));
        let rule = of("CET-1CEST,M3.5.0,M10.5.0/3").unwrap();
        assert_eq!([hour(&rule, summer), hour(&rule, winter)], [8.0, 7.0]);
        assert_eq!(hour(&of("").unwrap(), summer), 6.0);
        assert_eq!(hour(&of("<+03>-3").unwrap(), summer), 9.0);
        for name in ["Europe/Berlin", ":Europe/Berlin", "/usr/share/zoneinfo/Europe/Berlin"] {
            match of(name) {
                Ok(zone) => assert_eq!([hour(&zone, summer), hour(&zone, winter)], [8.0, 7.0], "{name}"),
                // A machine without time zone files reports that.
                Err(error) => assert!(error.reason.contains(name) && error.remedy.contains("tzdata"), "{error:?}"),
            }
        }
        for wrong in ["Europe/Atlantis", "CET", ":CET-1", "noon", " "] {
            match of(wrong) {
                // "CET" is a valid name on machines with time zone files.
                Ok(_) => assert_eq!(wrong, "CET"),
                Err(error) => assert!(error.reason.contains(wrong), "{error:?}"),
            }
        }
    }

    /// The test runs again in a separate process with the variable set.
    #[test]
    fn the_environment_of_a_process_sets_its_time_zone() {
        const VARIABLE: &str = "<+0317>-3:17";
        if std::env::var("TZ").is_ok_and(|value| value == VARIABLE) {
            assert_eq!(Zone::local().local_s(UnixNs(0)), 11_820.0);
            return;
        }
        let name = std::thread::current().name().unwrap().to_owned();
        let again = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", &name])
            .env("TZ", VARIABLE)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&again.stdout);
        assert!(again.status.success() && said.contains("1 passed"), "{said}");
    }
}
