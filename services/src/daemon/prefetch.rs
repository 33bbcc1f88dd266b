//! Prefetching: guesses of each person's next action, scored while the daemon is idle. [`super::prefetch_thread`] has the thread and the clock.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use roomcast_core::draft::Drafter;
use roomcast_core::guess::{Counts, Guesser, Thread};
use roomcast_core::ids::PersonId;
use roomcast_core::narration::Sentence;
use roomcast_core::prepared::{Answer, Ask, Outlook, PersonOutlook, Preparer};
use roomcast_core::scorer::{LanguageModel, ModelError, PreparedLabels, ScoreError};

/// The newest sentences that estimate which person acts next.
const ACTORS: usize = 16;

/// The daemon's state, for the prefetcher.
#[derive(Debug)]
pub struct Now {
    /// The persons and their latest events.
    pub outlook: Outlook,
    /// Changes when a person is forgotten.
    pub forgotten: u64,
}

#[derive(Debug, Default)]
struct Own {
    thread: Thread,
    /// The number of events in the person's history at the last look.
    heard: u64,
    /// The prompts that are answered since the last sentence.
    answered: BTreeSet<u64>,
    /// Per label `ln s_c` in nats, mixed with the drafter's scores. Empty if the drafter was not asked since the last sentence.
    drafted: Vec<f64>,
}

/// Prefetches answers with the model `M`; guesses also use the model `D`.
#[derive(Debug)]
pub struct Prefetcher<M, D = M> {
    preparer: Preparer<M>,
    drafter: Option<Drafter<D>>,
    counts: Counts,
    guesser: Guesser,
    labels: Arc<PreparedLabels>,
    /// Most guesses after each event, of all persons together.
    most: usize,
    persons: BTreeMap<PersonId, Own>,
    /// The persons of the last sentences.
    actors: Vec<PersonId>,
    now: Option<Now>,
    /// In reverse order: the next guess is at the end.
    waiting: Vec<(PersonId, Sentence)>,
}

impl<M: LanguageModel, D: LanguageModel> Prefetcher<M, D> {
    /// A prefetcher that knows the sentences of activity programs in `counts`, and answers up to `most` guesses after each event.
    pub fn new(preparer: Preparer<M>, counts: Counts, labels: Arc<PreparedLabels>, most: usize) -> Self {
        let guesser = guesser(&counts, &labels);
        let (drafter, persons, actors, now, waiting) = Default::default();
        Self { preparer, drafter, counts, guesser, labels, most, persons, actors, now, waiting }
    }

    /// Also uses another model's scores to choose guesses.
    #[must_use]
    pub fn with_drafter(self, drafter: Option<Drafter<D>>) -> Self {
        Self { drafter, ..self }
    }

    /// Learns the sentences since the last look, and chooses guesses to score.
    pub fn look(&mut self, now: Now) {
        let is_forgotten = self.now.as_ref().is_some_and(|before| before.forgotten != now.forgotten);
        if is_forgotten || self.guesser.is_full() {
            // The guesser holds sentences of a forgotten person, or can learn no more.
            self.guesser = guesser(&self.counts, &now.outlook.labels);
            self.persons.clear();
            self.actors.clear();
        } else if !Arc::ptr_eq(&self.labels, &now.outlook.labels) {
            self.guesser.set_labels(&texts(&now.outlook.labels));
            self.persons.values_mut().for_each(|own| own.drafted.clear());
        }
        if self.now.as_ref().is_some_and(|before| before.outlook.round() != now.outlook.round()) {
            self.persons.values_mut().for_each(|own| own.answered.clear());
        }
        self.labels = Arc::clone(&now.outlook.labels);
        self.hear(&now.outlook);
        self.plan(&now.outlook);
        self.now = Some(now);
    }

    fn hear(&mut self, outlook: &Outlook) {
        self.persons.retain(|person, _| outlook.persons.iter().any(|known| known.person == *person));
        for known in &outlook.persons {
            let (person, history) = (known.person, &known.history);
            let own = self.persons.entry(person).or_default();
            let told = history.told();
            let new = usize::try_from(told.saturating_sub(own.heard)).unwrap_or(usize::MAX);
            if new > history.len() {
                // The sentences between are unknown, so these follow an unknown one.
                own.thread = Thread::default();
            }
            if told != own.heard {
                own.answered.clear();
                own.drafted.clear();
            }
            for sentence in history.sentences().skip(history.len() - new.min(history.len())) {
                self.guesser.hear(&mut own.thread, sentence);
                self.actors.push(person);
            }
            own.heard = told;
            if history.is_empty() {
                // Sentences before a gap do not predict the next one.
                own.thread = Thread::default();
            }
        }
        self.actors.drain(..self.actors.len().saturating_sub(ACTORS));
    }

    fn draft(&mut self, outlook: &Outlook, known: &PersonOutlook) {
        let own = self.persons.get_mut(&known.person).filter(|own| own.drafted.is_empty());
        let (Some(drafter), Some(own)) = (&mut self.drafter, own) else { return };
        let mut said = known.label_log_prob_nats.clone();
        match drafter.mix(&outlook.labels, &known.history, &mut said) {
            Ok(()) => own.drafted = said,
            Err(ScoreError::Model(ModelError::Stopped)) => {}
            Err(error) => {
                tracing::warn!(%error, "the embedded model cannot say what is likely next: guesses go by the configured one alone from now on");
                self.drafter = None;
            }
        }
    }

    fn plan(&mut self, outlook: &Outlook) {
        let mut guesses: Vec<(PersonId, String, f64)> = Vec::new();
        for known in outlook.persons.iter().filter(|known| !known.label_log_prob_nats.is_empty()) {
            self.draft(outlook, known);
            let person = known.person;
            let Some(own) = self.persons.get(&person) else { continue };
            let said = if own.drafted.is_empty() { &known.label_log_prob_nats } else { &own.drafted };
            let own = self.guesser.guess(&own.thread, said, self.most);
            let whole: f64 = own.iter().map(|(_, chance)| chance).sum();
            let acts = 1 + self.actors.iter().filter(|actor| **actor == person).count();
            let chance = acts as f64 / whole.max(f64::MIN_POSITIVE);
            guesses.extend(own.into_iter().map(|(sentence, own)| (person, sentence, own * chance)));
        }
        guesses.sort_by(|a, b| b.2.total_cmp(&a.2));
        guesses.truncate(self.most);
        // The model keeps one decoded window: each person's guesses stand in a row, the most likely person first.
        let mut order: Vec<PersonId> = Vec::new();
        for (person, ..) in &guesses {
            if !order.contains(person) {
                order.push(*person);
            }
        }
        guesses.sort_by_key(|(person, ..)| order.iter().position(|other| other == person));
        let sentence = |(person, text, _): (PersonId, String, f64)| Some((person, Sentence::new(&text).ok()?));
        self.waiting.clear();
        self.waiting.extend(guesses.into_iter().rev().filter_map(sentence));
    }

    /// The next answer. `None` if all guesses are answered.
    ///
    /// # Errors
    /// If the model fails or was stopped: the remaining guesses are dropped until the next look.
    pub fn answer(&mut self) -> Result<Option<Answer>, ScoreError> {
        while let Some((person, sentence)) = self.waiting.pop() {
            let Some(ask) = self.ask(person, &sentence) else { continue };
            let number = ask.number();
            let answer = self.preparer.answer(ask).inspect_err(|_| self.waiting.clear())?;
            if let Some(own) = self.persons.get_mut(&person) {
                own.answered.insert(number);
            }
            return Ok(Some(answer));
        }
        Ok(None)
    }

    /// `None` if it is answered already.
    fn ask(&mut self, person: PersonId, sentence: &Sentence) -> Option<Ask> {
        let ask = self.preparer.ask(&self.now.as_ref()?.outlook, person, sentence)?;
        let own = self.persons.get(&person)?;
        (!own.answered.contains(&ask.number())).then_some(ask)
    }

    /// Whether all guesses are answered.
    #[must_use]
    pub fn is_done(&self) -> bool {
        self.waiting.is_empty()
    }
}

fn texts(labels: &PreparedLabels) -> Vec<&str> {
    labels.labels().iter().map(String::as_str).collect()
}

fn guesser(counts: &Counts, labels: &PreparedLabels) -> Guesser {
    Guesser::new(counts, &texts(labels))
}
