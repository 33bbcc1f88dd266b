//! The content of the state database, for a daemon that starts.

use std::collections::{BTreeMap, HashMap, HashSet};

use roomcast_core::ids::{EventId, PersonId};
use roomcast_core::narration::Observation;
use roomcast_ipc::Sender as Port;

use super::learned::HabitRows;
use super::record::{Expectation, KeptPerson, Move};
use crate::daemon::map_change::KeptMap;

/// The content of the database at the start.
#[derive(Debug, Default, Clone)]
pub struct Recovered {
    /// The observations, oldest first.
    pub observations: Vec<Observation>,
    /// All accepted observations in their order. If the observations of a narrator's start are gone, its last one stands for them.
    pub taken: Vec<EventId>,
    /// The port that speaks for a start of a source, by the source's number and epoch.
    pub ports: BTreeMap<(u64, u64), Port>,
    /// The index of an observation, its person, and the model's expectation; without rooms if the person was out.
    pub expectations: Vec<(usize, PersonId, Expectation)>,
    /// A person that was forgotten before an observation, by its index.
    pub forgotten: Vec<(usize, PersonId)>,
    /// The persons that observations moved. Other observations are read again.
    pub moved: HashMap<EventId, Vec<Move>>,
    /// Observations from before the machine's last start.
    pub of_other_boots: HashSet<EventId>,
    /// Per start of a source the last sequence number that is gone. Its narrator has a confirmation and must not count it as lost.
    pub settled: BTreeMap<(u64, u64), u64>,
    /// The persons with a name that the home gave.
    pub persons: Vec<KeptPerson>,
    /// The changed map.
    pub map: Option<KeptMap>,
    /// The habits; `None` if they were never written.
    pub habits: Option<HabitRows>,
    /// Events that cannot be read.
    pub damaged: u64,
}
