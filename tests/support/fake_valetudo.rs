//! A simulated robot for tests. It speaks the topics in Valetudo's documentation and cleans no room. It does no I/O: time and messages are arguments
//! and results.

use std::collections::BTreeMap;

const RETURN_S: f64 = 30.0;
/// Battery charge used by an hour of work, and gained in an hour at the dock.
const WORK_PER_H: f64 = 0.5;
const CHARGE_PER_H: f64 = 0.8;
/// The robot returns to its dock below `LOW`, and continues above `FULL`.
const LOW: f64 = 0.15;
const FULL: f64 = 0.8;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Doing {
    Docked,
    Idle,
    Cleaning,
    Paused,
    Returning,
    Error,
}

#[derive(Debug)]
pub(crate) struct FakeValetudo {
    topic: String,
    /// Seconds for each segment.
    segments: BTreeMap<String, f64>,
    names: BTreeMap<String, String>,
    pub(crate) doing: Doing,
    pub(crate) battery: f64,
    /// The segment in progress, and the seconds left.
    pub(crate) job: Option<(String, f64)>,
    home_s: f64,
    fault: String,
    /// The number of orders that the robot ignores first.
    pub(crate) orders_ignored: u32,
    /// The robot gets stuck once in this segment, and is freed after these seconds.
    pub(crate) sticks: Option<(String, f64)>,
    freed_s: f64,
    /// Completely cleaned segments, and all orders received.
    pub(crate) cleaned: Vec<String>,
    pub(crate) orders: Vec<String>,
    /// The last message on each topic.
    said: BTreeMap<String, String>,
}

impl FakeValetudo {
    /// A robot at its dock with a full battery. Each segment has a number, a name and seconds.
    pub(crate) fn new(topic: &str, segments: &[(&str, &str, f64)]) -> Self {
        Self {
            topic: topic.to_owned(),
            segments: segments.iter().map(|(number, _, seconds)| ((*number).to_owned(), *seconds)).collect(),
            names: segments.iter().map(|(number, name, _)| ((*number).to_owned(), (*name).to_owned())).collect(),
            doing: Doing::Docked,
            battery: 1.0,
            job: None,
            home_s: 0.0,
            fault: String::new(),
            orders_ignored: 0,
            sticks: None,
            freed_s: 0.0,
            cleaned: Vec::new(),
            orders: Vec::new(),
            said: BTreeMap::new(),
        }
    }

    pub(crate) fn hear(&mut self, topic: &str, payload: &str) {
        if self.orders_ignored > 0 {
            self.orders_ignored -= 1;
            return;
        }
        let Some(part) = topic.strip_prefix(&self.topic) else { return };
        match part {
            "/MapSegmentationCapability/clean/set" => {
                let order: serde_json::Value = serde_json::from_str(payload).unwrap();
                let segment = order["segment_ids"][0].as_str().unwrap().to_owned();
                assert_eq!(order["iterations"], 1, "{payload}");
                self.orders.push(format!("clean {segment}"));
                if self.doing != Doing::Error
                    && let Some(seconds) = self.segments.get(&segment)
                {
                    (self.job, self.doing) = (Some((segment, *seconds)), Doing::Cleaning);
                }
            }
            "/BasicControlCapability/operation/set" => {
                self.orders.push(payload.to_owned());
                match (payload, self.doing) {
                    (_, Doing::Error) => {}
                    ("STOP", Doing::Cleaning | Doing::Paused | Doing::Returning) => {
                        (self.job, self.doing) = (None, Doing::Idle);
                    }
                    ("STOP", _) => self.job = None,
                    ("PAUSE", Doing::Cleaning) => self.doing = Doing::Paused,
                    ("HOME", Doing::Cleaning | Doing::Paused | Doing::Idle) => {
                        (self.job, self.doing, self.home_s) = (None, Doing::Returning, RETURN_S);
                    }
                    _ => {}
                }
            }
            _ => {}
        }
    }

    pub(crate) fn pass(&mut self, seconds: f64) {
        match self.doing {
            Doing::Cleaning => {
                self.battery = (self.battery - WORK_PER_H * seconds / 3600.0).max(0.0);
                let Some((segment, left_s)) = &mut self.job else { return };
                *left_s -= seconds;
                if self.sticks.as_ref().is_some_and(|(there, _)| there == segment) {
                    let (_, freed_s) = self.sticks.take().unwrap();
                    (self.freed_s, self.job, self.doing) = (freed_s, None, Doing::Error);
                    self.fault = "Wheel lost floor contact".to_owned();
                } else if *left_s <= 0.0 {
                    self.cleaned.push(segment.clone());
                    (self.job, self.doing, self.home_s) = (None, Doing::Returning, RETURN_S);
                } else if self.battery < LOW {
                    (self.doing, self.home_s) = (Doing::Returning, RETURN_S);
                }
            }
            Doing::Returning => {
                self.home_s -= seconds;
                if self.home_s <= 0.0 {
                    self.doing = Doing::Docked;
                }
            }
            Doing::Docked => {
                self.battery = (self.battery + CHARGE_PER_H * seconds / 3600.0).min(1.0);
                if self.job.is_some() && self.battery >= FULL {
                    self.doing = Doing::Cleaning;
                }
            }
            Doing::Error => {
                self.freed_s -= seconds;
                if self.freed_s <= 0.0 {
                    self.fault.clear();
                    self.doing = Doing::Idle;
                }
            }
            Doing::Idle | Doing::Paused => {}
        }
    }

    pub(crate) fn free(&mut self) {
        self.freed_s = 0.0;
    }

    /// Retained messages that changed since the last call; with `again`, all of them.
    pub(crate) fn say(&mut self, again: bool) -> Vec<(String, String)> {
        if again {
            self.said.clear();
        }
        let status = match self.doing {
            Doing::Docked => "docked",
            Doing::Idle => "idle",
            Doing::Cleaning => "cleaning",
            Doing::Paused => "paused",
            Doing::Returning => "returning",
            Doing::Error => "error",
        };
        let resumes = self.job.is_some() && matches!(self.doing, Doing::Returning | Doing::Docked);
        let fault = if self.fault.is_empty() { "No error" } else { &self.fault };
        let all = [
            ("$state", "ready".to_owned()),
            ("MapData/segments", serde_json::to_string(&self.names).unwrap()),
            ("BatteryStateAttribute/level", format!("{:.0}", 100.0 * self.battery)),
            ("StatusStateAttribute/error_description", fault.to_owned()),
            ("StatusStateAttribute/flag", if resumes { "resumable" } else { "none" }.to_owned()),
            ("StatusStateAttribute/status", status.to_owned()),
        ];
        let all = all.map(|(part, payload)| (format!("{}/{part}", self.topic), payload));
        let said = &mut self.said;
        all.into_iter()
            .filter(|(topic, payload)| said.insert(topic.clone(), payload.clone()).as_ref() != Some(payload))
            .collect()
    }
}
