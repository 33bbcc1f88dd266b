//! What is scored while nobody waits: guesses at what each person does next. No clock, no thread: [`super::aside`] has these.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use roomcast_core::draft::Drafter;
use roomcast_core::guess::{Counts, Guesser, Thread};
use roomcast_core::ids::PersonId;
use roomcast_core::narration::Sentence;
use roomcast_core::prepared::{Answer, Ask, Outlook, PersonOutlook, Preparer};
use roomcast_core::scorer::{LanguageModel, ModelError, PreparedLabels, ScoreError};

/// Of so many sentences it counts who did them, to say who does the next.
const ACTORS: usize = 16;

/// What the daemon knows at one moment, for whoever works ahead.
#[derive(Debug)]
pub struct Now {
    /// Who is here, and what they did last.
    pub outlook: Outlook,
    /// Changes when somebody is forgotten.
    pub forgotten: u64,
}

/// Of one person.
#[derive(Debug, Default)]
struct Own {
    thread: Thread,
    /// How many sentences of their history were heard.
    heard: u64,
    /// The numbers of the prompts that are answered since.
    answered: BTreeSet<u64>,
    /// Per label `ln s_c` in nats with the drafter's say, since the last sentence; empty where it was not asked.
    drafted: Vec<f64>,
}

/// What is scored ahead, by `M`; `D` has a say in what is guessed.
#[derive(Debug)]
pub struct Ahead<M, D = M> {
    preparer: Preparer<M>,
    drafter: Option<Drafter<D>>,
    counts: Counts,
    guesser: Guesser,
    labels: Arc<PreparedLabels>,
    /// How many answers, of all persons together.
    most: usize,
    persons: BTreeMap<PersonId, Own>,
    /// Who did the last sentences.
    actors: Vec<PersonId>,
    now: Option<Now>,
    /// In reverse.
    waiting: Vec<(PersonId, Sentence)>,
}

impl<M: LanguageModel, D: LanguageModel> Ahead<M, D> {
    /// Knows what activity programs say, and answers up to `most` guesses after each event.
    pub fn new(preparer: Preparer<M>, counts: Counts, labels: Arc<PreparedLabels>, most: usize) -> Self {
        let guesser = guesser(&counts, &labels);
        let (drafter, persons, actors, now, waiting) = Default::default();
        Self { preparer, drafter, counts, guesser, labels, most, persons, actors, now, waiting }
    }

    /// Guesses with another model's say, too.
    #[must_use]
    pub fn with_drafter(self, drafter: Option<Drafter<D>>) -> Self {
        Self { drafter, ..self }
    }

    /// Learns what was said since the last time, and chooses what to score next.
    pub fn look(&mut self, now: Now) {
        let is_forgotten = self.now.as_ref().is_some_and(|before| before.forgotten != now.forgotten);
        if is_forgotten || self.guesser.is_full() {
            // It holds sentences of somebody who is forgotten, or can learn no more.
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
                // What lies between is not known: these came after something else.
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
                // What came before a gap does not say what comes after it.
                own.thread = Thread::default();
            }
        }
        self.actors.drain(..self.actors.len().saturating_sub(ACTORS));
    }

    /// Asks the drafter about somebody of whom something was said since it was asked last.
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
        // The model keeps one window read: each person's answers in a row, the likeliest person's first.
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

    /// The next answer; none where all are there.
    ///
    /// # Errors
    /// When the model fails or was stopped: nothing more is answered until the next look.
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

    /// The prompt that a person has after `sentence`, where there is one that is not answered yet.
    fn ask(&mut self, person: PersonId, sentence: &Sentence) -> Option<Ask> {
        let ask = self.preparer.ask(&self.now.as_ref()?.outlook, person, sentence)?;
        let own = self.persons.get(&person)?;
        (!own.answered.contains(&ask.number())).then_some(ask)
    }

    /// Whether all that was chosen is answered.
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
