//! Texts that name no place: the language model's rooms for them ("Mira is cooking.").
//!
//! A likelihood per room: the model's probability after the text alone, divided by its probability without narration. The text alone, because an
//! earlier sentence in the window would count twice; and because a restart then reads the same.

use std::collections::VecDeque;
use std::sync::Arc;

use roomcast_core::narration::Event;
use roomcast_core::scorer::LanguageModel;

use super::Engine;
use super::attribution::is_off;

/// Most texts whose rooms are kept, so that repeated texts cost no second pass of the model.
const KEPT: usize = 64;
/// Most texts that one step reads. A flood of texts must not delay the scores.
const PER_STEP: usize = 8;

#[derive(Debug, Default)]
pub(super) struct Readings {
    /// The model's rooms without narration.
    blank: Vec<f64>,
    texts: VecDeque<(Box<str>, Arc<[f64]>)>,
    left: usize,
    is_on: bool,
}

impl Readings {
    /// A step begins.
    pub(super) fn begin(&mut self) {
        self.left = PER_STEP;
    }

    /// Forgets all texts, because the map changed, or because they may name a forgotten person.
    pub(super) fn clear(&mut self) {
        self.blank.clear();
        self.texts.clear();
    }
}

impl<M: LanguageModel> Engine<M> {
    /// Lets texts without a place move the belief: the model knows language.
    #[must_use]
    pub(in crate::daemon) fn with_readings(mut self) -> Self {
        self.scoring.readings.is_on = true;
        self
    }

    /// The likelihood of a text in each room, if it names no place. `None` if the model fails, or if the step has read enough texts.
    pub(super) fn reading(&mut self, event: &Event) -> Option<Arc<[f64]>> {
        let text = event.sentence()?.as_str();
        let own = &mut self.scoring.readings;
        if !own.is_on || !self.map.is_scored() || self.map.matcher.last(text).is_some() || is_off(event) {
            return None;
        }
        if let Some((_, kept)) = own.texts.iter().find(|(kept, _)| **kept == *text) {
            return Some(Arc::clone(kept));
        }
        own.left = own.left.checked_sub(1)?;
        let mut model = self.scoring.pipeline.idle();
        let rooms = model.rooms_of(text).and_then(|(rooms, trust)| {
            if own.blank.len() != rooms.len() {
                (own.blank, _) = model.rooms_of("")?;
            }
            Ok((rooms, trust))
        });
        let (rooms, trust) =
            rooms.inspect_err(|error| tracing::debug!(%error, text, "failed to read a text without a place")).ok()?;
        let fits: Arc<[f64]> = (rooms.iter().zip(&own.blank))
            // A text of unknown words fits each room.
            .map(|(p, blank)| trust * p / blank.max(1e-6) + (1.0 - trust))
            .collect();
        own.texts.truncate(KEPT - 1);
        own.texts.push_front((text.into(), Arc::clone(&fits)));
        Some(fits)
    }

    /// Reads the texts that the forecasts do not have yet.
    pub(super) fn read_seen(&mut self) {
        for at in 0..self.belief.seen.len() {
            if std::mem::take(&mut self.belief.seen[at].is_read) {
                let event = self.belief.seen[at].event.clone();
                self.belief.seen[at].rooms = self.reading(&event);
            }
        }
    }
}
