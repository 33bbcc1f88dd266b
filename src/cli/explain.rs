//! `roomcast explain`: the chain behind the scores of one moment, as text, JSON and plan: of a given narration, of a running system, or of a
//! recording.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use roomcast_ipc::question;

use super::{CommandResult, Failure, count, draw, ranges, record, score, service};
use crate::exit_code;
use crate::reasons::{called, why_text};
use roomcast_core::explanation::{Explanation, PartitionReason};
use roomcast_core::grounding::Grounding;
use roomcast_core::ids::{BootNs, PersonId};
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::narration::{Event, Observation};
use roomcast_core::pipeline::{Pipeline, PipelineOptions};
use roomcast_core::scorer::LanguageModel;
use roomcast_core::scorer::correction::CorrectionChoice;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_services::daemon::{PersonAnswer, PersonQuestion, Whereabouts};
use roomcast_services::moment::{Explained, Moment};
use roomcast_services::recording::RecordedMoment;
use roomcast_services::setup;
use roomcast_simulation::drawing::{self, Heat};

/// Options that affect only the scores of a given narration. They exclude `--recording`, which `--at` and `--sequence` require. clap drops a
/// requirement if another option excludes it, so `--at` and `--sequence` exclude these options too.
const OF_A_NARRATION: [&str; 11] = [
    "text",
    "narration",
    "program",
    "steps",
    "method",
    "effort",
    "deadline_ms",
    "tokenisation",
    "continuation",
    "prior",
    "history",
];
/// Options that a running daemon has in its configuration.
const OF_A_MODEL: [&str; 7] = ["scene", "model", "binding", "level", "no_room_labels", "threads", "cache"];

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    #[command(flatten)]
    score: score::Args,
    /// Explain the newest scores of the running system, from its daemon.
    #[arg(long, conflicts_with = "recording", conflicts_with_all = OF_A_NARRATION, conflicts_with_all = OF_A_MODEL)]
    live: bool,
    /// Explain scores of a recording of `roomcast record`: they are computed again and compared.
    #[arg(long, value_name = "FILE", conflicts_with_all = OF_A_NARRATION)]
    recording: Option<PathBuf>,
    /// The moment, in seconds from the recording's beginning: the last scores before it. Without it, the last scores of all.
    #[arg(long, value_name = "SECONDS", requires = "recording", conflicts_with_all = ["sequence", "live"], conflicts_with_all = OF_A_NARRATION, value_parser = ranges::time_s)]
    at: Option<f64>,
    /// The scores' sequence number.
    #[arg(long, value_name = "N", requires = "recording", conflicts_with = "live", conflicts_with_all = OF_A_NARRATION, value_parser = ranges::any())]
    sequence: Option<u64>,
    /// Explain the scores of this person alone. Without it, those of each person, one after the other.
    #[arg(long, value_name = "WHO")]
    person: Option<String>,
    /// Print the daemon's belief about this person's place, and the observations with the largest effect on it.
    #[arg(long = "where", value_name = "WHO", conflicts_with_all = ["live", "recording", "at", "sequence", "person", "plan"], conflicts_with_all = OF_A_NARRATION, conflicts_with_all = OF_A_MODEL)]
    whereabouts: Option<String>,
    /// Also draw the plan with the heat of every room and item; the ending, `.svg` or `.png`, selects the format. PNG needs a build with the feature
    /// `png`.
    #[arg(long, value_name = "FILE")]
    plan: Option<PathBuf>,
}

const PATIENCE: Duration = Duration::from_secs(10);

pub fn run(args: &Args) -> CommandResult {
    if let Some(who) = &args.whereabouts {
        return whereabouts(args, who);
    }
    if !args.live && args.service.on_command_line() {
        let text = "--config, --root and --domain name a running system: give --live, too, or leave them out";
        return Err(Failure::new(exit_code::USAGE, text));
    }
    let (moment, note) = if args.live {
        let (_, domain) = args.service.load()?;
        let ipc = |error| Failure::new(exit_code::IPC, error);
        let port =
            domain.open("roomcast-explain").and_then(|node| node.question_port(question::MOMENT)).map_err(ipc)?;
        let answer = port.ask("{}", PATIENCE).map_err(ipc)?;
        let moment = Moment::from_json(&answer).map_err(|error| Failure::new(exit_code::IPC, error))?;
        let note = format!("Scores {} of the daemon {}.", moment.sequence, moment.epoch);
        (moment, Some(note))
    } else if let Some(path) = &args.recording {
        let (moment, note) = recorded(args, path)?;
        (moment, Some(note))
    } else {
        let (pipeline, map) = score::scored(&args.score)?;
        (Moment::of(&pipeline, &map, &args.score.grounding(), None), None)
    };
    let failed = |error| Failure::new(exit_code::FAILURE, error);
    let unknown = |error| Failure::new(exit_code::INPUT, error);
    let moment = match &args.person {
        Some(who) => moment.find(who).and_then(|person| moment.of_person(person)).map_err(unknown)?,
        None => moment,
    };
    let explained = moment.explain(args.score.top()).map_err(failed)?;
    if let Some(path) = &args.plan {
        draw_plan(&explained, path)?;
    }
    // Each person has a chain. The combined probability of several persons is not a sum over labels.
    let persons = moment.persons.iter().map(|own| {
        let explained = moment.of_person(own.person).and_then(|alone| alone.explain(args.score.top()));
        explained.map(|explained| (own.person, explained.explanation))
    });
    let persons: Vec<_> = persons.collect::<Result<_, _>>().map_err(failed)?;
    if args.score.json() {
        let failed_json = |error: serde_json::Error| Failure::new(exit_code::FAILURE, error);
        let mut value = serde_json::to_value(&explained.explanation).map_err(failed_json)?;
        if !moment.habits.is_empty() {
            let mut habits = serde_json::to_value(&moment.habits).map_err(failed_json)?;
            for (own, learned) in habits.as_array_mut().into_iter().flatten().zip(&moment.habits) {
                own["name"] = moment.names.get(&learned.person).cloned().into();
            }
            value["habits"] = habits;
        }
        if !persons.is_empty() {
            let person = |(person, explanation): &(PersonId, Explanation)| {
                let name = moment.names.get(person);
                serde_json::json!({"person": person, "name": name, "explanation": explanation})
            };
            value["persons"] = persons.iter().map(person).collect();
            // The combined probability is not a sum over labels.
            value["partitions"] = somebody(&persons);
            if let Some(object) = value.as_object_mut() {
                object.remove("label_mass");
            }
        }
        return super::print_json(&value);
    }
    let mut text = note.map_or_else(String::new, |note| format!("{note}\n\n"));
    if persons.is_empty() {
        let _ = write!(text, "{}", explained.explanation);
        let own = moment.person_numbers().first().and_then(|person| moment.habits_of(*person));
        let _ = own.map_or(Ok(()), |own| write!(text, "\n{own}"));
    }
    for (person, explanation) in &persons {
        let name = moment.name_of(*person);
        let _ = write!(text, "{}\n\n{explanation}\n", heading(&name));
        let _ = moment.habits_of(*person).map_or(Ok(()), |own| writeln!(text, "{own}"));
    }
    super::print(&text)
}

/// A person's name as a heading, with capitals.
fn heading(name: &str) -> String {
    let capital = |word: &str| word.chars().take(1).flat_map(char::to_uppercase).chain(word.chars().skip(1)).collect();
    name.split(' ').map(capital).collect::<Vec<String>>().join(" ")
}

/// Per partition the probability that it is the next one of any of the persons, the likeliest first.
fn somebody(persons: &[(PersonId, Explanation)]) -> serde_json::Value {
    let Some((_, first)) = persons.first() else { return serde_json::Value::Null };
    let of = |explanation: &Explanation, id: &str| {
        let own = explanation.partitions.iter().find(|partition| partition.id == id);
        own.map_or(0.0, |partition| partition.probability)
    };
    let any = |id: &str| 1.0 - persons.iter().map(|(_, own)| 1.0 - of(own, id)).product::<f64>();
    let mut partitions: Vec<_> = first.partitions.iter().map(|partition| (any(&partition.id), partition)).collect();
    partitions.sort_by(|a, b| b.0.total_cmp(&a.0));
    let row = |(probability, partition): (f64, &PartitionReason)| {
        serde_json::json!({
            "id": partition.id, "label": partition.label, "name": partition.name, "probability": probability,
        })
    };
    partitions.into_iter().map(row).collect()
}

/// Prints the belief about a person's place, with reasons.
fn whereabouts(args: &Args, who: &str) -> CommandResult {
    let (_, domain) = args.service.load()?;
    let asker = service::Asker::new(&domain, "roomcast-explain", question::PERSON, PATIENCE.as_secs())?;
    let answer: PersonAnswer = asker.ask(&PersonQuestion::Where { who: who.to_owned() })?;
    let Some(found) = answer.whereabouts else {
        return Err(Failure::new(
            exit_code::INPUT,
            answer.reason.unwrap_or_else(|| "the daemon gives no place".to_owned()),
        ));
    };
    if args.score.json() {
        return super::print_json(&found);
    }
    super::print(&told(&found))
}

/// A belief about a person in words.
fn told(found: &Whereabouts) -> String {
    let name = called(&found.person);
    let mut text = String::new();
    for place in &found.places {
        let _ = writeln!(text, "{name} {}: {:.0} %", place.place, 100.0 * place.probability);
        for why in &place.why {
            let _ = writeln!(text, "    {}", why_text(&name, why, &format!("{:.0} s ago", why.ago_s)));
        }
    }
    let _ = writeln!(text, "house empty: {:.0} %", 100.0 * found.house_empty);
    if found.is_joint {
        let _ = writeln!(text, "an unknown person in the house: {:.0} %", 100.0 * found.visited);
    } else {
        text.push_str("No sensor reported yet, and no event of two possible persons: each event has one person.\n");
    }
    for sensor in &found.noisy {
        let _ = writeln!(
            text,
            "{} turns on {:.1} times a day without a person; {:.1} are usual: move it, or set false_alarms_per_day",
            sensor.id, sensor.per_day, sensor.usual_per_day
        );
    }
    text
}

fn draw_plan(explained: &Explained, path: &Path) -> CommandResult {
    let Explained { explanation, map, grounding, scores, item_log_score_nats } = explained;
    let caption = explanation.narration.last().map_or("", String::as_str);
    let heat = Heat::new(&scores.partition_probability, item_log_score_nats, caption);
    let svg = drawing::svg(map, grounding, Some(&heat)).map_err(|error| Failure::new(exit_code::FAILURE, error))?;
    draw::write_drawing(path, svg, 2.0)
}

/// Computes the scores of a recorded moment again, and compares them with the recorded ones.
fn recorded(args: &Args, path: &Path) -> Result<(Moment, String), Failure> {
    let input = |error: String| Failure::new(exit_code::INPUT, error);
    let recording = record::read(path)?;
    let shown = path.display();
    let RecordedMoment { scores, at_s, base, narration, silent, names, habits } =
        recording.moment(args.sequence, args.at).ok_or_else(|| {
            input(format!(
                "the recording {shown} has no such scores; without --at and --sequence the last ones are explained"
            ))
        })?;
    let base = base.map(|index| &recording.moments[index]);
    if base.is_some() && args.score.says_binding_or_partitions() {
        let text = format!(
            "{shown} says the binding sequence and the partitions itself: leave out --binding, --level and --no-room-labels"
        );
        return Err(Failure::new(exit_code::USAGE, text));
    }
    let (scene, model, options) = args.score.scene_and_model();
    let map = match (scene, base) {
        (None, Some(moment)) => {
            SemanticMap::from_json(&moment.scene.to_string()).map_err(|error| input(error.to_string()))?
        }
        (scene, _) => setup::load_map(scene)?,
    };
    let wanted = (hex::encode(scores.map_fingerprint), hex::encode(scores.model_fingerprint));
    if hex::encode(map.fingerprint()) != wanted.0 {
        let (name, wanted) = (map.name(), &wanted.0);
        return Err(input(format!(
            "the recorded scores are of a map with the fingerprint {wanted}, {name} is another one; give --scene FILE"
        )));
    }
    let model = roomcast_cli::model::load(model, &options)?;
    if hex::encode(model.info().fingerprint) != wanted.1 {
        let (name, wanted) = (&model.info().name, &wanted.1);
        return Err(Failure::new(
            exit_code::MODEL,
            format!(
                "the recorded scores are of a model with the SHA-256 {wanted}, {name} is another one; give --model FILE"
            ),
        ));
    }
    let grounding = base.map_or_else(|| args.score.grounding(), |moment| moment.grounding);
    let binding = base.map_or_else(|| Ok(args.score.binding()), Moment::binding);
    let binding = binding.map_err(|error| input(error.to_string()))?;
    let grounded = Grounding::new(&map, &grounding).map_err(|error| input(error.to_string()))?;
    // The given narration is the window: none of it may be cut.
    let history = HistoryLimits { observations: narration.len().max(1), slack: 0, tokens: usize::MAX, gap_s: 0 };
    let correction = base.map_or_else(CorrectionChoice::default, |moment| CorrectionChoice::exactly(moment.correction));
    let tokenisation = base.map_or_else(Default::default, |moment| moment.tokenisation);
    let options = PipelineOptions { binding, history, correction, tokenisation, ..PipelineOptions::default() };
    let failed = |error| Failure::new(exit_code::MODEL, error);
    let mut pipeline = Pipeline::new(model, grounded, options).map_err(failed)?;
    let window = narration.len() as u64;
    let presence = |is_here: bool| if is_here { Event::Present(None) } else { Event::Away };
    let silent = silent.iter().map(|&(person, is_here)| (person, presence(is_here)));
    let events = silent.chain(narration.into_iter().map(|(person, sentence)| (person, Event::Did(sentence))));
    let observations = (1..).zip(events).map(|(sequence, (person, event))| Observation {
        person,
        source: 1,
        epoch: 1,
        observed_ns: BootNs(sequence),
        ..Observation::saying(sequence, event)
    });
    pipeline.step(observations).map_err(failed)?;
    let again = &pipeline.scores().grounded.partition_probability;
    let difference = (scores.rooms().iter().zip(again))
        .map(|(room, probability)| (room.probability - probability).abs())
        .fold(0.0, f64::max);
    let mut note = format!(
        "Scores {} at {at_s:.3} s of {shown}, computed again: the recorded probabilities differ by at most {difference:.1e}.",
        scores.sequence
    );
    if window != scores.window {
        let _ =
            write!(note, "\nThey contain {}; the recording has {window}.", count(scores.window as usize, "narration"));
    }
    Ok((Moment { names, habits, ..Moment::of(&pipeline, &map, &grounding, Some(&scores)) }, note))
}
