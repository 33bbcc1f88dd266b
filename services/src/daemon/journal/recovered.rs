//! What the journal says to a daemon that starts.

use std::collections::{BTreeMap, HashMap, HashSet};

use roomcast_core::ids::{EventId, PersonId};
use roomcast_core::narration::Observation;
use roomcast_ipc::Sender as Port;

use super::record::{BOOT_AT, Expectation, HEADER_BYTES, MAGIC, MAGICS, Move, Moved, Record, decode};

/// What was found at the start.
#[derive(Debug, Default, Clone)]
pub struct Recovered {
    /// The observations, oldest first.
    pub observations: Vec<Observation>,
    /// What is no history any more, but was taken: the last ones of sources that have been silent since, and what forgotten persons did.
    pub carried: Vec<Observation>,
    /// Per carried one, before which of the observations it stands.
    pub carried_before: Vec<usize>,
    /// The port that speaks for a start of a source, by the source's number and epoch.
    pub ports: BTreeMap<(u64, u64), Port>,
    /// What the model said of a person after one of the observations, whose index comes first; without rooms of one who was out.
    pub expectations: Vec<(usize, PersonId, Expectation)>,
    /// Who was forgotten, after the index of the observation that came next.
    pub forgotten: Vec<(usize, PersonId)>,
    /// Whom observations moved, by event. Of others it is read in them.
    pub moved: HashMap<EventId, Vec<Move>>,
    /// The last observations of persons that were made before all these, until [`Recovered::join`] puts them in their place.
    pub(super) kept: KeptWords,
    /// Those that were made before the machine was started last.
    pub of_other_boots: HashSet<EventId>,
    /// The places of the observations.
    pub(super) places: HashMap<EventId, usize>,
    /// Bytes that were no record: a torn end, or damage.
    pub damaged_bytes: u64,
    /// There was a full half, so that a rotation may have dropped what came before it.
    pub(super) has_rotated: bool,
}

/// What was last said of persons before all that is in the halves; places are indices of these observations.
#[derive(Debug, Default, Clone)]
pub(super) struct KeptWords {
    observations: Vec<Observation>,
    expectations: Vec<(usize, PersonId, Expectation)>,
    forgotten: Vec<(usize, PersonId)>,
    places: HashMap<EventId, usize>,
}

impl Recovered {
    /// Whether an observation was read before.
    fn has(&self, observation: &Observation) -> bool {
        let event = observation.id();
        self.places.contains_key(&event) || self.kept.places.contains_key(&event)
    }

    /// All that was taken, in its order.
    pub fn taken(&self) -> impl Iterator<Item = &Observation> {
        let mut carried = self.carried_before.iter().zip(&self.carried).peekable();
        let mut observations = self.observations.iter().enumerate().peekable();
        std::iter::from_fn(move || {
            let next = observations.peek().map_or(usize::MAX, |(index, _)| *index);
            let first = carried.next_if(|(before, _)| **before <= next).map(|(_, observation)| observation);
            first.or_else(|| observations.next().map(|(_, observation)| observation))
        })
    }

    /// Per start of a source up to which sequence rotations have dropped what it said. A narrator that was told of it must not take it for lost.
    #[must_use]
    pub fn settled(&self) -> BTreeMap<(u64, u64), u64> {
        let mut settled = BTreeMap::new();
        if self.has_rotated {
            for Observation { source, epoch, sequence, .. } in &self.observations {
                settled.entry((*source, *epoch)).or_insert(sequence.saturating_sub(1));
            }
        }
        for Observation { source, epoch, sequence, .. } in &self.carried {
            let last = settled.entry((*source, *epoch)).or_default();
            *last = (*last).max(*sequence);
        }
        settled
    }

    /// What became of an observation that was read before; of one that is gone it says nothing.
    fn note_outcome(&mut self, event: EventId, person: PersonId, by_fit: bool, expectation: Expectation) {
        let Self { observations, expectations, kept, places, .. } = self;
        let found = match places.get(&event) {
            Some(index) => Some((*index, observations, expectations)),
            None => kept.places.get(&event).map(|index| (*index, &mut kept.observations, &mut kept.expectations)),
        };
        let Some((index, observations, expectations)) = found else { return };
        if by_fit {
            let observation = &mut observations[index];
            (observation.person, observation.by_fit) = (person, true);
        }
        // Of whom an observation is that named nobody was told beside it.
        if !by_fit {
            expectations.push((index, person, expectation));
        }
    }

    /// The same with the last observations of persons that were made before these in their place, the first.
    #[must_use]
    pub fn join(mut self) -> Self {
        let KeptWords { mut observations, mut expectations, mut forgotten, .. } = std::mem::take(&mut self.kept);
        let before = observations.len();
        self.carried_before.iter_mut().for_each(|index| *index += before);
        observations.append(&mut self.observations);
        expectations.extend(self.expectations.drain(..).map(|(index, person, said)| (index + before, person, said)));
        forgotten.extend(self.forgotten.drain(..).map(|(index, person)| (index + before, person)));
        Self { observations, expectations, forgotten, ..self }
    }
}

/// Reads all records of a file's bytes after those that were read before; whatever is none is counted and stepped over. Monotonic times of
/// another boot than `boot_id` become 0.
pub fn read_records(bytes: &[u8], boot_id: &[u8; 16], recovered: &mut Recovered) {
    let mut rest = bytes;
    let mut begins = true;
    while !rest.is_empty() {
        match decode(rest, boot_id) {
            Some((record, length)) => {
                if begins && matches!(record, Record::Kept(_) | Record::Forgotten { is_before: true, .. }) {
                    // What a newer half begins with has all of what the older one began with.
                    recovered.kept = KeptWords::default();
                    begins = false;
                }
                let made_in = rest.get(HEADER_BYTES + BOOT_AT..).and_then(|rest| rest.first_chunk());
                if let Record::Observation(observation) | Record::Kept(observation) = &record
                    && made_in != Some(boot_id)
                {
                    recovered.of_other_boots.insert(observation.id());
                }
                match record {
                    // A disk may give a block twice, or one as it was before: what is named the same is the same.
                    Record::Observation(observation) if recovered.has(&observation) => {}
                    Record::Kept(observation) if recovered.has(&observation) => {}
                    Record::Observation(observation) => {
                        recovered.places.insert(observation.id(), recovered.observations.len());
                        recovered.observations.push(observation);
                    }
                    Record::Carried(observation) => {
                        recovered.carried.push(observation);
                        recovered.carried_before.push(recovered.observations.len());
                    }
                    Record::Outcome { event, person, by_fit, expectation } => {
                        recovered.note_outcome(event, person, by_fit, expectation);
                    }
                    Record::Moved(Moved { observation, moves }) => {
                        recovered.moved.insert(observation, moves);
                    }
                    Record::Port { name, port } => {
                        recovered.ports.insert(name, port);
                    }
                    Record::Kept(observation) => {
                        let kept = &mut recovered.kept;
                        kept.places.insert(observation.id(), kept.observations.len());
                        kept.observations.push(observation);
                    }
                    Record::Forgotten { person, is_before: true } => {
                        recovered.kept.forgotten.push((recovered.kept.observations.len(), person));
                    }
                    Record::Forgotten { person, is_before: false } => {
                        recovered.forgotten.push((recovered.observations.len(), person));
                    }
                }
                rest = &rest[length..];
            }
            None => {
                let next = rest[1..].windows(MAGIC.len()).position(|window| MAGICS.iter().any(|magic| window == magic));
                let skipped = next.map_or(rest.len(), |next| next + 1);
                recovered.damaged_bytes += skipped as u64;
                rest = &rest[skipped..];
            }
        }
    }
}
