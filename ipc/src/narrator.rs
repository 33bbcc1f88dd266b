//! A narrator: reports the actions and places of persons.

use std::time::{Duration, Instant};

use crate::ask::{self, Understood};
use crate::raw::{Message, NarrationV1, RoomScoresV1, narration_kind};
use crate::{Domain, IpcError, Node, Publisher, Sensor, Subscriber, Who, clock, question, sequence, text};

/// Events that may be under way to the daemon: as many as the service keeps for a daemon that restarts.
pub const UNDER_WAY_MAX: u64 = NarrationV1::SERVICE.history as u64;
/// How long a full narrator waits for the daemon, and how long [`Narrator::close`] does.
const PATIENCE: Duration = Duration::from_secs(10);
/// The daemon may name an event that it drops before an event that it took earlier. After this time the difference counts.
const SURE: Duration = Duration::from_secs(2);
const TICK: Duration = Duration::from_millis(100);

/// Counts the events that the daemon has taken.
#[derive(Debug, Default)]
struct Account {
    /// Events that the daemon has dealt with, taken or not.
    settled: u64,
    daemon: Option<u64>,
    dealt_with: u64,
    accepted: u64,
    since: u64,
    before: u64,
}

impl Account {
    /// Events that the daemon has dealt with and has not taken.
    fn dropped(&self) -> u64 {
        self.before + self.dealt_with.saturating_sub(self.accepted.saturating_sub(self.since))
    }

    fn take(&mut self, daemon: u64, dealt_with: u64, accepted: u64, sent: u64) {
        let mut more = dealt_with.min(sent).saturating_sub(self.settled);
        self.settled += more;
        if self.daemon.is_some_and(|known| known != daemon) {
            // A restarted daemon may know less than it did. Then these events count as taken.
            (self.before, self.dealt_with, self.since, more) = (self.dropped(), 0, accepted, 0);
        }
        (self.daemon, self.accepted, self.dealt_with) = (Some(daemon), accepted, self.dealt_with + more);
    }
}

/// Reports the actions and places of persons: [`Domain::narrator`].
///
/// At most [`UNDER_WAY_MAX`] events are under way. The next one waits until the daemon has dealt with some, and is an error after 10 s. A
/// narrator that is dropped loses the events that the daemon has not received: [`Narrator::close`] waits for them.
#[derive(Debug)]
pub struct Narrator {
    publisher: Publisher<NarrationV1>,
    scores: Subscriber<RoomScoresV1>,
    node: Node,
    name: String,
    source: u64,
    epoch: u64,
    sequence: u64,
    account: Account,
    included: u64,
}

/// An event that was sent.
#[derive(Debug)]
pub struct Said<'a> {
    narrator: &'a mut Narrator,
    receivers: usize,
    /// Events that the daemon had dropped before.
    dropped: u64,
}

impl Said<'_> {
    /// The participants that received the event; 0 if no daemon runs. A daemon that starts later receives it while the narrator lives.
    #[must_use]
    pub fn receivers(&self) -> usize {
        self.receivers
    }

    /// Waits until the daemon's scores contain the event, and returns how the daemon understood it. Without `daemon.state`, the event ends with
    /// the daemon.
    ///
    /// # Errors
    ///
    /// [`IpcError::NotIncluded`] when the time is over or the daemon has dropped the event, and as [`Narrator::understood`].
    pub fn confirmed(self, timeout: Duration) -> Result<Understood, IpcError> {
        let start = Instant::now();
        let narrator = self.narrator;
        let sequence = narrator.sequence;
        narrator.wait(timeout, self.dropped)?;
        let left = timeout.saturating_sub(start.elapsed()).max(TICK);
        let understood = narrator.understood(sequence, left)?.into_iter().find(|event| event.sequence == sequence);
        understood.ok_or_else(|| narrator.not_included("the daemon has no record of the last event"))
    }
}

impl Narrator {
    pub(crate) fn open(domain: &Domain, name: &str) -> Result<Self, IpcError> {
        let node = domain.open(name)?;
        Ok(Self {
            publisher: node.publisher()?,
            scores: node.subscriber()?,
            node,
            name: name.to_owned(),
            source: sequence::source_of_name(name),
            epoch: sequence::random_epoch(),
            sequence: 0,
            account: Account::default(),
            included: 0,
        })
    }

    /// An action of a person: `did("ada", "opens the fridge")`. The text is what the person does, or a whole sentence.
    ///
    /// # Errors
    ///
    /// [`IpcError::Argument`] and [`IpcError::Refused`] for a person or a text that cannot be sent, [`IpcError::NotIncluded`] when too many
    /// events are under way, [`IpcError::Port`].
    pub fn did(&mut self, who: impl Into<Who>, text: &str) -> Result<Said<'_>, IpcError> {
        let who = who.into();
        let text = text.trim();
        let sentence = if text.starts_with(char::is_lowercase) {
            let subject = if let Who::Name(name) = &who { name.as_str() } else { "Somebody" };
            format!("{subject} {}.", text.trim_end_matches('.'))
        } else {
            text.to_owned()
        };
        self.send(narration_kind::SENTENCE, &sentence, &who, 0)
    }

    /// A sentence about an unknown person: `say("They grab the mug.")`.
    ///
    /// # Errors
    ///
    /// As [`Narrator::did`].
    pub fn say(&mut self, sentence: &str) -> Result<Said<'_>, IpcError> {
        self.send(narration_kind::SENTENCE, sentence, &Who::Somebody, 0)
    }

    /// A sentence about so many unknown persons, at most 8.
    ///
    /// # Errors
    ///
    /// As [`Narrator::did`].
    pub fn several(&mut self, count: u32, sentence: &str) -> Result<Said<'_>, IpcError> {
        self.send(narration_kind::SENTENCE, sentence, &Who::Somebody, count)
    }

    /// A completed action in VirtualHome's notation: `act("ada", "[Grab] <mug> (1)")`.
    ///
    /// # Errors
    ///
    /// As [`Narrator::did`].
    pub fn act(&mut self, who: impl Into<Who>, action: &str) -> Result<Said<'_>, IpcError> {
        if !action.trim_start().starts_with('[') {
            let remedy = "give a verb in brackets, then things, such as \"[Grab] <mug> (1)\"";
            return Err(IpcError::Argument(format!("action {action:?}: {remedy}")));
        }
        self.send(narration_kind::ACTION, action, &who.into(), 0)
    }

    /// A device's state: `device("the oven is on")`.
    ///
    /// # Errors
    ///
    /// As [`Narrator::did`].
    pub fn device(&mut self, state: &str) -> Result<Said<'_>, IpcError> {
        self.send(narration_kind::DEVICE, state, &Who::Somebody, 0)
    }

    /// A person is in the house, in a room if it is known.
    ///
    /// # Errors
    ///
    /// As [`Narrator::did`].
    pub fn present(&mut self, who: impl Into<Who>, room: Option<&str>) -> Result<Said<'_>, IpcError> {
        let text = match room {
            Some(room) => format!("present in the {}", Self::room(room)?),
            None => "present".to_owned(),
        };
        self.send(narration_kind::PRESENCE, &text, &who.into(), 0)
    }

    /// A person is out of the house, and expected back.
    ///
    /// # Errors
    ///
    /// As [`Narrator::did`].
    pub fn away(&mut self, who: impl Into<Who>) -> Result<Said<'_>, IpcError> {
        self.send(narration_kind::PRESENCE, "away", &who.into(), 0)
    }

    /// A person is out of the house, and not expected back.
    ///
    /// # Errors
    ///
    /// As [`Narrator::did`].
    pub fn gone(&mut self, who: impl Into<Who>) -> Result<Said<'_>, IpcError> {
        self.send(narration_kind::PRESENCE, "gone", &who.into(), 0)
    }

    /// A room has no people in it.
    ///
    /// # Errors
    ///
    /// As [`Narrator::did`].
    pub fn empty(&mut self, room: &str) -> Result<Said<'_>, IpcError> {
        let text = format!("nobody in the {}", Self::room(room)?);
        self.send(narration_kind::PRESENCE, &text, &Who::Somebody, 0)
    }

    /// The state of a sensor. `owner` is the owner of a bed or a phone, [`Who::Somebody`] for other sensors.
    ///
    /// # Errors
    ///
    /// As [`Narrator::did`].
    pub fn sensor(&mut self, owner: impl Into<Who>, sensor: &Sensor<'_>) -> Result<Said<'_>, IpcError> {
        self.send(narration_kind::PRESENCE, &sensor.text()?, &owner.into(), 0)
    }

    fn room(room: &str) -> Result<&str, IpcError> {
        let room = room.trim();
        match room.chars().any(char::is_alphanumeric) {
            true => Ok(room),
            false => Err(IpcError::Argument(format!("room {room:?}: give a room's name"))),
        }
    }

    fn send(&mut self, kind: u32, content: &str, who: &Who, count: u32) -> Result<Said<'_>, IpcError> {
        let refused = |source| IpcError::Refused { service: NarrationV1::SERVICE.name, source };
        if !content.chars().any(char::is_alphanumeric) {
            return Err(IpcError::Argument(format!("text {content:?}: it has no letter and no digit; say something")));
        }
        let (person, name) = who.in_message()?;
        let person_name = text::encode("person_name", name).map_err(refused)?;
        let message = NarrationV1::new(kind, content).map_err(refused)?;
        let (observed_ns, observed_unix_ns) = (clock::monotonic_ns(), clock::unix_ns());
        self.wait_for_room()?;
        let message = NarrationV1 {
            source: self.source,
            epoch: self.epoch,
            sequence: self.sequence + 1,
            observed_ns,
            observed_unix_ns,
            person,
            person_name,
            count,
            source_name: text::encode_cut(&self.name),
            ..message
        };
        let receivers = self.publisher.send(&message)?;
        self.sequence += 1;
        let dropped = self.account.dropped();
        Ok(Said { narrator: self, receivers, dropped })
    }

    /// Events that the daemon has not dealt with, as far as its newest scores say.
    #[must_use]
    pub fn under_way(&self) -> u64 {
        self.sequence - self.account.settled
    }

    /// Events that the daemon has dropped: too many, too long, or sent under another narrator's name.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.account.dropped()
    }

    /// How the daemon understood this narrator's events from the number `first` on, the oldest first. The daemon remembers its newest 512
    /// events.
    ///
    /// # Errors
    ///
    /// [`IpcError::NoAnswer`] without a daemon, [`IpcError::Answer`] for an answer of another version, [`IpcError::Port`].
    pub fn understood(&self, first: u64, timeout: Duration) -> Result<Vec<Understood>, IpcError> {
        let asked = ask::PersonQuestion::Understood { source: self.source, epoch: self.epoch, from: first };
        let answer: ask::PersonAnswer = ask::ask(&self.node, question::PERSON, &asked, timeout)?;
        Ok(answer.understood)
    }

    /// Waits until the daemon's scores contain all events of this narrator.
    ///
    /// # Errors
    ///
    /// [`IpcError::NotIncluded`] when the time is over, or when the daemon has dealt with all events and has dropped some.
    pub fn wait_until_included(&mut self, timeout: Duration) -> Result<(), IpcError> {
        self.wait(timeout, 0)
    }

    /// Waits until the scores contain all events but those that the daemon had dropped before.
    fn wait(&mut self, timeout: Duration, dropped: u64) -> Result<(), IpcError> {
        let start = Instant::now();
        let mut sure: Option<Instant> = None;
        loop {
            self.look()?;
            if self.included >= self.sequence {
                if self.dropped() <= dropped {
                    return Ok(());
                }
                if sure.get_or_insert_with(Instant::now).elapsed() >= SURE {
                    break;
                }
            }
            let left = timeout.saturating_sub(start.elapsed());
            if left.is_zero() {
                break;
            }
            self.publisher.tick()?;
            self.scores.wait(left.min(TICK))?;
        }
        Err(self.not_included("the scores do not contain all events"))
    }

    /// Waits up to 10 s until the daemon's scores contain all events, and leaves the domain.
    ///
    /// # Errors
    ///
    /// As [`Narrator::wait_until_included`].
    pub fn close(mut self) -> Result<(), IpcError> {
        self.wait_until_included(PATIENCE)
    }

    fn look(&mut self) -> Result<(), IpcError> {
        while let Some(scores) = self.scores.receive()? {
            let own =
                |included: &&crate::raw::IncludedV1| (included.source, included.epoch) == (self.source, self.epoch);
            if let Some(included) = scores.included().iter().find(own) {
                self.account.take(scores.epoch, included.sequence, included.accepted, self.sequence);
                self.included = included.sequence;
            }
        }
        Ok(())
    }

    fn wait_for_room(&mut self) -> Result<(), IpcError> {
        self.look()?;
        let start = Instant::now();
        while self.under_way() >= UNDER_WAY_MAX {
            if start.elapsed() >= PATIENCE {
                return Err(self.not_included("no further event can be sent"));
            }
            self.publisher.tick()?;
            self.scores.wait(TICK)?;
            self.look()?;
        }
        Ok(())
    }

    fn not_included(&self, problem: &'static str) -> IpcError {
        IpcError::NotIncluded {
            narrator: self.name.clone(),
            problem,
            under_way: self.under_way(),
            dropped: self.dropped(),
            sent: self.sequence,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_that_scores_name_and_do_not_count_as_accepted_is_dropped() {
        let mut account = Account::default();
        account.take(1, 3, 2, 5);
        assert_eq!((account.settled, account.dropped()), (3, 1));
        account.take(1, 5, 4, 5);
        assert_eq!((account.settled, account.dropped()), (5, 1));
    }

    #[test]
    fn a_restarted_daemon_that_knows_less_drops_nothing() {
        let mut account = Account::default();
        account.take(1, 3, 3, 5);
        account.take(2, 5, 1, 5);
        assert_eq!((account.settled, account.dropped()), (5, 0));
    }
}
