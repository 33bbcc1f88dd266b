//! One published snapshot with all data behind its scores, as the daemon answers it and recordings store it. Recordings have the scores as
//! published, and this on request.
//!
//! A moment is data, and JSON between processes (`roomcast/v1/moment`): the map in use, the narration that the model read, and each label's
//! tokens with their log-probabilities. The pure functions of [`roomcast_core::grounding`] and [`roomcast_core::explanation`] compute
//! everything else (items, rooms) from these, so a reader of a moment can recompute every number of it.

use std::collections::BTreeMap;

use roomcast_ipc::raw::{NAME_BYTES, RoomScoresV1};
use serde::{Deserialize, Serialize};

use crate::habits_reason::PersonHabits;
use roomcast_core::explanation::{self, Evidence, Explanation, TokenReason};
use roomcast_core::grounding::{GroundedScores, Grounding, GroundingError, GroundingOptions};
use roomcast_core::ids::{PersonId, UnixNs};
use roomcast_core::narration::{ReadName, same_name};
use roomcast_core::pipeline::{PersonScores, Pipeline};
use roomcast_core::prompt::{BindingError, BindingSequence};
use roomcast_core::scorer::correction::Correction;
use roomcast_core::scorer::{LanguageModel, Tokenisation};
use roomcast_core::semantic_map::{SceneError, SemanticMap};
use roomcast_core::text::is_hidden;

/// Version of the JSON form. New keys do not change it.
pub const VERSION: u32 = 1;

/// A moment cannot be explained.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MomentError {
    /// The text is not a moment's JSON.
    #[error("the moment is malformed: {0}; do both sides have the same version of Roomcast?")]
    Json(#[from] serde_json::Error),
    /// A version that this program does not know.
    #[error("the moment has version {0}, this program knows {VERSION}; use the same version of Roomcast on both sides")]
    Version(u32),
    /// The map in the moment is malformed.
    #[error("the moment's map is malformed")]
    Scene(#[from] SceneError),
    /// The scores do not match the map.
    #[error("the moment's scores do not fit its map")]
    Grounding(#[from] GroundingError),
    /// The person has no scores.
    #[error("the moment has no scores of {who}; it has those of {known}")]
    NoPerson {
        /// The person asked for.
        who: String,
        /// The persons with scores.
        known: String,
    },
    /// A person's name is not allowed.
    #[error("person {person} of the moment is called {name:?}, which is no name; was the file damaged or forged?")]
    BadName {
        /// The person.
        person: PersonId,
        /// The name.
        name: String,
    },
    /// No person with scores has the name.
    #[error(
        "nobody of whom there are scores is called {who:?}; there are scores of {known}, and of nobody who was not observed yet"
    )]
    NoName {
        /// The name asked for.
        who: String,
        /// The persons with scores.
        known: String,
    },
    /// All known persons are out of the house.
    #[error("everybody who is known is away: no room is likely, and there is nothing to explain")]
    NobodyHome,
    /// A label of the map has no score.
    #[error(
        "the moment has no score for the label {0:?} of its map; its scoring failed, ask again after the next event"
    )]
    NoScore(String),
}

/// A sentence that the model read.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReadSentence {
    /// The person of the sentence.
    pub person: PersonId,
    /// The sentence.
    pub text: String,
}

/// The newest narration of a source in the scores.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct IncludedSource {
    /// The source, hexadecimal.
    pub source: String,
    /// Its epoch, hexadecimal.
    pub epoch: String,
    /// Its sequence number in that epoch.
    pub sequence: u64,
}

/// The model's score of a label.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LabelScore {
    /// The label.
    pub label: String,
    /// ln s_c in nats; `None` for a probability of zero, since JSON has no infinity.
    pub log_prob_nats: Option<f64>,
    /// Its tokens; empty if the scorer does not know their probabilities one by one (several persons, other methods than the exact trie).
    pub tokens: Vec<TokenReason>,
    /// The prior's part, in nats.
    #[serde(default)]
    pub prior_nats: f64,
}

/// The model's scores of the labels for one person.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PersonLabels {
    /// The person.
    pub person: PersonId,
    /// The scores for this person alone.
    pub labels: Vec<LabelScore>,
}

/// All data behind the scores of one moment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Moment {
    /// [`VERSION`].
    pub version: u32,
    /// Epoch of the daemon's scores, hexadecimal; empty if the scores are not a daemon's.
    pub epoch: String,
    /// Sequence of the scores.
    pub sequence: u64,
    /// The time of the scores in Unix nanoseconds, 0 if unknown.
    pub computed_unix_ns: UnixNs,
    /// The model's name.
    pub model: String,
    /// SHA-256 of the model file, hexadecimal.
    pub model_fingerprint: String,
    /// SHA-256 of the map, hexadecimal.
    pub map_fingerprint: String,
    /// The options of the grounding.
    pub grounding: GroundingOptions,
    /// The name of the binding sequence: a built-in name, or `custom`.
    pub binding_name: String,
    /// The text of the binding sequence.
    pub binding: String,
    /// The tokenisation of prompt and labels.
    #[serde(default)]
    pub tokenisation: Tokenisation,
    /// The correction of the scores; in recordings without it, plain Equation 1.
    #[serde(default)]
    pub correction: Correction,
    /// The sentences that the model read, the oldest first.
    pub narration: Vec<ReadSentence>,
    /// The newest narration of each source in the scores.
    pub included: Vec<IncludedSource>,
    /// The scores of the labels for one person, or for several persons together with equal weights.
    pub labels: Vec<LabelScore>,
    /// The scores for each of several persons.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub persons: Vec<PersonLabels>,
    /// The person of the scores, if they are for one person alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub alone: Option<PersonId>,
    /// The names of persons, by number.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub names: BTreeMap<PersonId, String>,
    /// The learned habits, by person. They affect the forecasts, not the scores.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub habits: Vec<PersonHabits>,
    /// All known persons are out of the house, so no label has a score.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub nobody_home: bool,
    /// The map, as a scene file.
    pub scene: serde_json::Value,
}

/// An explained moment, with the data for a drawing.
#[derive(Debug)]
pub struct Explained {
    /// The chain behind every score.
    pub explanation: Explanation,
    /// The map.
    pub map: SemanticMap,
    /// Its grounding.
    pub grounding: Grounding,
    /// The item and room scores, recomputed from the labels' scores.
    pub scores: GroundedScores,
    /// ln s_i for each item.
    pub item_log_score_nats: Vec<f64>,
}

impl Moment {
    /// The moment after a pipeline's last step. Epoch, sequence and time are from `snapshot`, if the scores are in one.
    #[must_use]
    pub fn of<M: LanguageModel>(
        pipeline: &Pipeline<M>,
        map: &SemanticMap,
        grounding: &GroundingOptions,
        snapshot: Option<&RoomScoresV1>,
    ) -> Self {
        let texts = pipeline.grounding().label_texts();
        let log_probs_nats = &pipeline.scores().label_log_prob_nats;
        let labels = texts.iter().zip(log_probs_nats).enumerate().map(|(index, (text, &log_prob_nats))| {
            let pieces =
                pipeline.inside().prepared().tokens()[index].iter().map(|&token| pipeline.inside().token_text(token));
            let own = pipeline.inside().token_log_prob_nats(index).unwrap_or_default();
            let tokens = pieces.zip(own).map(|(piece, log_prob_nats)| TokenReason { piece, log_prob_nats });
            LabelScore {
                label: (*text).to_owned(),
                log_prob_nats: log_prob_nats.is_finite().then_some(log_prob_nats),
                tokens: tokens.collect(),
                prior_nats: pipeline.inside().prior_nats(index),
            }
        });
        let own_labels = |own: PersonScores<'_>| PersonLabels {
            person: own.person,
            labels: (texts.iter().zip(own.label_log_prob_nats).enumerate())
                .map(|(index, (text, &log_prob_nats))| LabelScore {
                    label: (*text).to_owned(),
                    log_prob_nats: log_prob_nats.is_finite().then_some(log_prob_nats),
                    tokens: Vec::new(),
                    prior_nats: pipeline.inside().prior_nats_of_person(own.person, index),
                })
                .collect(),
        };
        let at_home = || pipeline.persons().filter(|own| own.at_home);
        let several = at_home().count() > 1;
        let persons = at_home().filter(|_| several).map(own_labels).collect();
        let narration = pipeline.inside().read_sentences();
        Self {
            version: VERSION,
            epoch: snapshot.map_or_else(String::new, |snapshot| format!("{:016x}", snapshot.epoch)),
            sequence: snapshot.map_or(0, |snapshot| snapshot.sequence),
            computed_unix_ns: snapshot.map_or(UnixNs(0), |snapshot| UnixNs(snapshot.computed_unix_ns)),
            model: pipeline.inside().model().name.clone(),
            model_fingerprint: hex::encode(pipeline.inside().model().fingerprint),
            map_fingerprint: hex::encode(map.fingerprint()),
            grounding: *grounding,
            binding_name: pipeline.inside().options().binding.name().to_owned(),
            binding: pipeline.inside().options().binding.text().to_owned(),
            tokenisation: pipeline.inside().prepared().tokenisation(),
            correction: pipeline.inside().prepared().correction(),
            narration: narration.map(|(person, text)| ReadSentence { person, text: text.to_owned() }).collect(),
            included: (pipeline.scores().included.iter())
                .map(|included| IncludedSource {
                    source: format!("{:016x}", included.source),
                    epoch: format!("{:016x}", included.epoch),
                    sequence: included.sequence,
                })
                .collect(),
            labels: labels.collect(),
            persons,
            alone: at_home().next().filter(|_| !several).map(|own| own.person),
            names: BTreeMap::new(),
            habits: Vec::new(),
            nobody_home: pipeline.persons().next().is_some() && at_home().next().is_none(),
            scene: serde_json::from_str(&map.to_json()).unwrap_or_default(),
        }
    }

    /// Reads a moment's JSON.
    ///
    /// # Errors
    /// If the text is malformed, has another version, or contains a name that is not allowed.
    pub fn from_json(text: &str) -> Result<Self, MomentError> {
        let moment: Self = serde_json::from_str(text)?;
        if moment.version != VERSION {
            return Err(MomentError::Version(moment.version));
        }
        match moment.names.iter().find(|(_, name)| name.contains(is_hidden) || name.len() > NAME_BYTES) {
            Some((person, name)) => {
                Err(MomentError::BadName { person: *person, name: name.chars().take(NAME_BYTES).collect() })
            }
            None => Ok(moment),
        }
    }

    /// The persons with scores, by number. Without them, the persons of the narration.
    #[must_use]
    pub fn person_numbers(&self) -> Vec<PersonId> {
        let scored = self.persons.iter().map(|own| own.person).chain(self.alone);
        let mut persons: Vec<PersonId> = scored.collect();
        if persons.is_empty() {
            persons.extend(self.narration.iter().map(|sentence| sentence.person));
        }
        persons.sort_unstable();
        persons.dedup();
        persons
    }

    fn whose_scores(&self) -> String {
        let names: Vec<String> = self.person_numbers().into_iter().map(|person| self.name_of(person)).collect();
        if names.is_empty() { "nobody".to_owned() } else { names.join(", ") }
    }

    /// The person's name, or `person` and the number.
    #[must_use]
    pub fn name_of(&self, person: PersonId) -> String {
        self.names.get(&person).cloned().unwrap_or_else(|| format!("person {person}"))
    }

    /// The person's number by name or number. A name may differ in accents or a title if only one person fits.
    ///
    /// # Errors
    /// If the name fits no person, or several.
    pub fn find(&self, who: &str) -> Result<PersonId, MomentError> {
        let of = |is_meant: &dyn Fn(&str) -> bool| -> Vec<PersonId> {
            self.names.iter().filter(|(_, name)| is_meant(name)).map(|(number, _)| *number).collect()
        };
        if let Ok(number) = who.trim().parse() {
            return Ok(number);
        }
        if let Some(number) = of(&|name| same_name(name, who)).first() {
            return Ok(*number);
        }
        match of(&|name| ReadName::new(name).may_be_one(&ReadName::new(who)))[..] {
            [number] => Ok(number),
            _ => Err(MomentError::NoName { who: who.to_owned(), known: self.whose_scores() }),
        }
    }

    /// The moment for one person alone.
    ///
    /// # Errors
    /// If the person has no scores.
    pub fn of_person(&self, person: PersonId) -> Result<Self, MomentError> {
        let labels = match self.persons.iter().find(|own| own.person == person) {
            Some(own) => own.labels.clone(),
            None if self.persons.is_empty() && self.person_numbers() == [person] => self.labels.clone(),
            None => return Err(MomentError::NoPerson { who: self.name_of(person), known: self.whose_scores() }),
        };
        let narration = self.narration.iter().filter(|sentence| sentence.person == person).cloned().collect();
        let habits = self.habits_of(person).cloned().into_iter().collect();
        Ok(Self { labels, narration, habits, persons: Vec::new(), alone: Some(person), ..self.clone() })
    }

    /// The learned habits of a person.
    #[must_use]
    pub fn habits_of(&self, person: PersonId) -> Option<&PersonHabits> {
        self.habits.iter().find(|own| own.person == person)
    }

    /// The binding sequence.
    ///
    /// # Errors
    /// When its text cannot be one.
    pub fn binding(&self) -> Result<BindingSequence, BindingError> {
        BindingSequence::built_in(&self.binding_name).map_or_else(|| BindingSequence::custom(&self.binding), Ok)
    }

    /// Grounds the labels' scores in the map again, and explains every room by its `most_labels` largest contributions.
    ///
    /// # Errors
    /// When the map is malformed, or the scores are not of its labels.
    pub fn explain(&self, most_labels: usize) -> Result<Explained, MomentError> {
        if self.nobody_home {
            return Err(MomentError::NobodyHome);
        }
        let map = SemanticMap::from_json(&self.scene.to_string())?;
        let grounding = Grounding::new(&map, &self.grounding)?;
        let known: std::collections::HashMap<&str, &LabelScore> =
            self.labels.iter().map(|score| (score.label.as_str(), score)).collect();
        let labels: Vec<&LabelScore> = (grounding.label_texts().into_iter())
            .map(|text| known.get(text).copied().ok_or_else(|| MomentError::NoScore(text.to_owned())))
            .collect::<Result<_, _>>()?;
        let label_log_prob_nats: Vec<f64> =
            labels.iter().map(|score| score.log_prob_nats.unwrap_or(f64::NEG_INFINITY)).collect();
        let mut scores = GroundedScores::default();
        grounding.ground(&label_log_prob_nats, &mut scores)?;
        let several = self.narration.iter().any(|sentence| sentence.person != self.narration[0].person);
        let narration: Vec<String> = (self.narration.iter())
            .map(|sentence| match several {
                true => format!("({}) {}", self.name_of(sentence.person), sentence.text),
                false => sentence.text.clone(),
            })
            .collect();
        let evidence = Evidence {
            map: &map,
            grounding: &grounding,
            label_log_prob_nats: &label_log_prob_nats,
            scores: &scores,
            narration: &narration,
            binding: &self.binding,
        };
        let explanation = explanation::explain(&evidence, most_labels, |label| {
            (labels[label].tokens.clone(), labels[label].prior_nats)
        });
        let item_log_score_nats = grounding.item_log_score_nats(&label_log_prob_nats).collect();
        Ok(Explained { explanation, map, grounding, scores, item_log_score_nats })
    }
}

#[cfg(test)]
mod tests {
    use roomcast_core::narration::{Event, Observation, RoomName, Sentence};
    use roomcast_core::pipeline::PipelineOptions;
    use roomcast_core::scorer::table::TableModel;

    use super::*;

    /// With several persons, each person's scores are explained as if the person were alone.
    #[test]
    fn each_persons_scores_can_be_explained() {
        let map = SemanticMap::from_json(include_str!("../../tests/data/two_rooms.json")).unwrap();
        let options = GroundingOptions::default();
        let pipeline = || {
            let grounding = Grounding::new(&map, &options).unwrap();
            Pipeline::new(TableModel::new(7), grounding, PipelineOptions::default()).unwrap()
        };
        let said = |person: PersonId, sentence: &str| Observation {
            person,
            ..Observation::of(u64::from(person.0) + 1, Sentence::new(sentence).unwrap())
        };
        let observations = [said(PersonId(0), "They grab the mug."), said(PersonId(4), "They sit on the sofa.")];
        let mut both = pipeline();
        both.step(observations.clone()).unwrap();
        let moment = Moment::of(&both, &map, &options, None);
        let moment = Moment::from_json(&serde_json::to_string(&moment).unwrap()).unwrap();
        assert_eq!(moment.person_numbers(), [0, 4].map(PersonId));
        moment.explain(3).unwrap();
        for observation in observations {
            let person = observation.person;
            let mut alone = pipeline();
            alone.step([observation.clone()]).unwrap();
            let explained = moment.of_person(person).unwrap().explain(3).unwrap();
            assert_eq!(explained.scores.partition_probability, alone.scores().grounded.partition_probability);
            assert_eq!(explained.explanation.narration, [observation.sentence().unwrap()]);
            let own = Moment::of(&alone, &map, &options, None);
            assert!(own.persons.is_empty());
            assert_eq!(own.of_person(person).unwrap(), own);
        }
        let named = Moment { names: [(PersonId(4), "Ada".to_owned())].into(), ..moment.clone() };
        assert_eq!(named.explain(3).unwrap().explanation.narration[1], "(Ada) They sit on the sofa.");
        assert_eq!((named.find("ada").unwrap(), named.find("0").unwrap()), (PersonId(4), PersonId(0)));
        let forged = Moment { names: [(PersonId(4), "Ada\u{1b}[2J\nBen".to_owned())].into(), ..moment.clone() };
        let refused = Moment::from_json(&serde_json::to_string(&forged).unwrap()).unwrap_err().to_string();
        assert!(refused.contains("person 4") && !refused.contains('\u{1b}') && !refused.contains('\n'), "{refused}");
        assert!(Moment::from_json(&serde_json::to_string(&named).unwrap()).is_ok());
        assert!(named.find("ben").unwrap_err().to_string().contains("\"ben\""));
        // Other commands accept these forms of names, too.
        let names = [(4, "Zoë"), (5, "Mrs. Novak"), (6, "Mr. Novak"), (7, "Grandma Edith"), (8, "Edith")];
        let called =
            Moment { names: names.map(|(number, name)| (PersonId(number), name.to_owned())).into(), ..moment.clone() };
        for (who, number) in
            [("Zoe", Some(4)), ("zoë", Some(4)), ("Novak", None), ("Edith", Some(8)), ("Mr. Novák", Some(6))]
        {
            assert_eq!(called.find(who).ok(), number.map(PersonId), "{who}");
        }
        let unknown = called.of_person(PersonId(3)).unwrap_err().to_string();
        assert_eq!(unknown, "the moment has no scores of person 3; it has those of person 0, Zoë");
        let unnamed = called.find("Tom").unwrap_err().to_string();
        assert!(unnamed.contains("called \"Tom\"; there are scores of person 0, Zoë"), "{unnamed}");
    }

    /// A home of sensors: a person's room is reported, and there are no sentences.
    #[test]
    fn whoever_is_told_by_presence_alone_can_be_explained() {
        let map = SemanticMap::from_json(include_str!("../../tests/data/two_rooms.json")).unwrap();
        let options = GroundingOptions::default();
        let present = |person: PersonId| {
            let event = Event::Present(Some(RoomName::new("kitchen").unwrap()));
            Observation { person, ..Observation::saying(u64::from(person.0), event) }
        };
        let habits = |person: PersonId| PersonHabits { person, observations: 247.0, ..PersonHabits::default() };
        for persons in [&[PersonId(4)][..], &[PersonId(4), PersonId(7)]] {
            let grounding = Grounding::new(&map, &options).unwrap();
            let mut pipeline = Pipeline::new(TableModel::new(7), grounding, PipelineOptions::default()).unwrap();
            pipeline.step(persons.iter().copied().map(present)).unwrap();
            let moment = Moment {
                habits: [4, 7].map(PersonId).map(habits).into(),
                names: [(PersonId(4), "Ada".to_owned())].into(),
                ..Moment::of(&pipeline, &map, &options, None)
            };
            let moment = Moment::from_json(&serde_json::to_string(&moment).unwrap()).unwrap();
            assert!(moment.narration.is_empty());
            assert_eq!(moment.person_numbers(), persons);
            let own = moment.of_person(moment.find("Ada").unwrap()).unwrap();
            assert_eq!((own.person_numbers(), &own.habits[..]), (vec![PersonId(4)], &[habits(PersonId(4))][..]));
            own.explain(3).unwrap();
        }
    }
}
