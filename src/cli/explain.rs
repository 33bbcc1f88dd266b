//! `roomcast explain`: the chain behind the scores of one moment, as text, JSON and plan: of a given narration, of a running system, or of a
//! recording.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use roomcast_ipc::question;
use serde_json::{Value, json};

use super::{CommandResult, Failure, draw, ranges, record, score, service};
use crate::columns::prose;
use crate::reasons::{called, why_text};
use roomcast_core::explanation::{Explanation, PartitionReason};
use roomcast_core::ids::PersonId;
use roomcast_services::daemon::{PersonAnswer, PersonQuestion, Whereabouts};
use roomcast_services::habits_reason::ELSEWHERE;
use roomcast_services::moment::{Explained, Moment};
use roomcast_services::recording::{self, RecordedMoment, Wanted};
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
    /// Explain scores of a recording of `roomcast record`.
    #[arg(long, value_name = "FILE", conflicts_with_all = OF_A_NARRATION, conflicts_with_all = OF_A_MODEL)]
    recording: Option<PathBuf>,
    /// The moment, in seconds from the recording's beginning: the last scores before it. Without it, the last scores of all.
    #[arg(long, value_name = "SECONDS", requires = "recording", conflicts_with_all = ["sequence", "live"], conflicts_with_all = OF_A_NARRATION, conflicts_with_all = OF_A_MODEL, value_parser = ranges::time_s)]
    at: Option<f64>,
    /// The scores' sequence number.
    #[arg(long, value_name = "N", requires = "recording", conflicts_with = "live", conflicts_with_all = OF_A_NARRATION, conflicts_with_all = OF_A_MODEL, value_parser = ranges::any())]
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
        return Err(Failure::usage(text));
    }
    let mut flags = Vec::new();
    let (moment, note) = if args.live {
        let (_, domain) = args.service.load()?;
        let port = domain.open("roomcast-explain").and_then(|node| node.question_port(question::MOMENT))?;
        let answer = port.ask("{}", PATIENCE)?;
        let moment = Moment::from_json(&answer).map_err(Failure::ipc)?;
        let note = format!("Scores {} of the daemon {}.", moment.sequence, moment.epoch);
        (moment, Some(note))
    } else if let Some(path) = &args.recording {
        let (moment, note) = recorded(args, path)?;
        (moment, Some(note))
    } else {
        let (pipeline, map) = score::scored(&args.score)?;
        let warning = score::warning(&pipeline);
        flags.extend(warning.as_ref().map(|(flag, _)| *flag));
        let note = warning.map(|(_, text)| prose(&text));
        (Moment::of(&pipeline, &map, &args.score.grounding(), None), note)
    };
    let moment = match &args.person {
        Some(who) => moment.find(who).and_then(|person| moment.of_person(person)).map_err(Failure::input)?,
        None => moment,
    };
    let explained = moment.explain(args.score.top).map_err(Failure::failed)?;
    if let Some(path) = &args.plan {
        draw_plan(&explained, path)?;
    }
    // Each person has a chain. The combined probability of several persons is not a sum over labels.
    let persons = moment.persons.iter().map(|own| {
        let explained = moment.of_person(own.person).and_then(|alone| alone.explain(args.score.top));
        explained.map(|explained| (own.person, explained.explanation))
    });
    let persons: Vec<_> = persons.collect::<Result<_, _>>().map_err(Failure::failed)?;
    if args.score.json {
        let mut value = json!(explained.explanation);
        if !flags.is_empty() {
            value["flags"] = flags.into();
        }
        if !moment.habits.is_empty() {
            let mut habits = json!(moment.habits);
            for (own, learned) in habits.as_array_mut().into_iter().flatten().zip(&moment.habits) {
                own["name"] = moment.names.get(&learned.person).cloned().into();
            }
            value["habits"] = habits;
        }
        if !persons.is_empty() {
            let person = |(person, explanation): &(PersonId, Explanation)| {
                let name = moment.names.get(person);
                json!({"person": person, "name": name, "explanation": explanation})
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

fn heading(name: &str) -> String {
    let capital = |word: &str| word.chars().take(1).flat_map(char::to_uppercase).chain(word.chars().skip(1)).collect();
    name.split(' ').map(capital).collect::<Vec<String>>().join(" ")
}

/// Per partition the probability that it is the next one of any of the persons, the likeliest first.
fn somebody(persons: &[(PersonId, Explanation)]) -> Value {
    let Some((_, first)) = persons.first() else { return Value::Null };
    let of = |explanation: &Explanation, id: &str| {
        let own = explanation.partitions.iter().find(|partition| partition.id == id);
        own.map_or(0.0, |partition| partition.probability)
    };
    let any = |id: &str| 1.0 - persons.iter().map(|(_, own)| 1.0 - of(own, id)).product::<f64>();
    let mut partitions: Vec<_> = first.partitions.iter().map(|partition| (any(&partition.id), partition)).collect();
    partitions.sort_by(|a, b| b.0.total_cmp(&a.0));
    let row = |(probability, partition): (f64, &PartitionReason)| {
        json!({
            "id": partition.id, "label": partition.label, "name": partition.name, "probability": probability,
        })
    };
    partitions.into_iter().map(row).collect()
}

fn whereabouts(args: &Args, who: &str) -> CommandResult {
    let (_, domain) = args.service.load()?;
    let asker = service::Asker::new(&domain, "roomcast-explain", question::PERSON, PATIENCE.as_secs())?;
    let answer: PersonAnswer = asker.ask(&PersonQuestion::Where { who: who.to_owned() })?;
    let Some(found) = answer.whereabouts else {
        return Err(Failure::input(answer.reason.unwrap_or_else(|| "the daemon gives no place".to_owned())));
    };
    if args.score.json {
        return super::print_json(&found);
    }
    super::print(&told(&found))
}

fn told(found: &Whereabouts) -> String {
    let name = called(&found.person);
    let mut text = String::new();
    for place in &found.places {
        // As `person list` and `person correct` say it.
        let shown = if place.place == ELSEWHERE { "away" } else { &place.place };
        let _ = writeln!(text, "{name} {shown}: {:.0} %", 100.0 * place.probability);
        for why in &place.why {
            let _ = writeln!(text, "    {}", why_text(&name, why, &format!("{:.0} s ago", why.ago_s)));
        }
    }
    let _ = writeln!(text, "house empty: {:.0} %", 100.0 * found.house_empty);
    if found.is_joint {
        let [one, two] = [found.visited, found.visited_by_two].map(|own| 100.0 * own);
        let _ = writeln!(text, "unknown persons in the house: one or more {one:.0} %, two or more {two:.0} %");
        if !found.is_followed {
            let _ = writeln!(
                text,
                "The filter does not follow {name}: it follows 14 persons, and if named narrators report, only their persons."
            );
        }
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
    let svg = drawing::svg(map, grounding, Some(&heat)).map_err(Failure::failed)?;
    draw::write_drawing(path, svg, 2.0)
}

fn recorded(args: &Args, path: &Path) -> Result<(Moment, String), Failure> {
    let wanted = match (args.sequence, args.at) {
        (Some(sequence), _) => Wanted::Sequence(sequence),
        (None, Some(at_s)) => Wanted::At(at_s),
        (None, None) => Wanted::Last,
    };
    let shown = path.display();
    let found = recording::moment(path, wanted).map_err(Failure::input)?;
    let RecordedMoment { at_s, moment, is_torn } = found.ok_or_else(|| {
        Failure::input(format!(
            "the recording {shown} has no snapshot of these scores; without --at and --sequence the last one is explained"
        ))
    })?;
    if is_torn {
        record::tell_torn(path, "");
    }
    let note = format!("Scores {} of the daemon {}, {at_s:.3} s into {shown}.", moment.sequence, moment.epoch);
    Ok((moment, note))
}
