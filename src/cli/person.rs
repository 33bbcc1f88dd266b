//! `roomcast person`: lists, corrects, renames and forgets the persons that the daemon knows.

use std::time::Duration;

use roomcast_ipc::question;
use roomcast_ipc::raw::narration_kind;

use super::{CommandResult, Failure, print, service, table};
use crate::exit_code;
use crate::flags::plain;
use roomcast_core::narration::{Event, ReadName, TextError, check_name};
use roomcast_core::text::{did_you_mean, odd_name, visible};
use roomcast_services::daemon::{PersonAnswer, PersonQuestion};
use roomcast_services::habits_reason::ELSEWHERE;
use roomcast_services::narrator::{self, CORRECTIONS, Input, Item, Pace, Who};

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// List the known persons: number, name, presence in the house, and since when.
    List(Common),
    /// Forget a person: events, place, name, habits, and the entries of the state database.
    Forget {
        /// A name or a number.
        who: String,
        #[command(flatten)]
        common: Common,
    },
    /// Correct the belief: a person is in a room, or out of the house. The daemon takes it as evidence.
    ///
    /// If the configuration names narrators, it needs one of the name "roomcast-person" that may send presence.
    Correct {
        /// A name or a number.
        who: String,
        /// The room where the person is, or "away".
        room: String,
        #[command(flatten)]
        common: Common,
    },
    /// Give a person a name; narrators may use it or the number.
    Rename {
        /// A name or a number.
        who: String,
        /// The new name.
        name: String,
        #[command(flatten)]
        common: Common,
    },
}

#[derive(Debug, clap::Args)]
struct Common {
    #[command(flatten)]
    asking: service::Asking,
    /// Print the daemon's answer as JSON.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> CommandResult {
    let id = service::question_name();
    let (common, question) = match &args.action {
        Action::List(common) => (common, PersonQuestion::List),
        Action::Forget { who, common } => (common, PersonQuestion::Forget { id, who: who.clone() }),
        Action::Rename { who, name, common } => {
            check_name(name).map_err(Failure::usage)?;
            (common, PersonQuestion::Rename { id, who: who.clone(), name: name.clone() })
        }
        Action::Correct { who, room, common } => return correct(who, room, common),
    };
    let answer: PersonAnswer = common.asking.asker("roomcast-person", question::PERSON)?.ask(&question)?;
    if common.json {
        super::print_json(&answer)?;
    }
    let reason = answer.reason.as_deref().unwrap_or("no reason given");
    if !answer.done {
        let code = if answer.failed { exit_code::FAILURE } else { exit_code::INPUT };
        return Err(Failure::new(code, format!("the daemon changed nothing: {reason}")));
    }
    if answer.reason.is_some() {
        return Err(Failure::failed(reason));
    }
    if common.json {
        return Ok(());
    }
    if let Action::Rename { name, .. } = &args.action {
        let others = answer.persons.iter().filter_map(|line| line.name.as_deref());
        if let Some(odd) = odd_name(name, others) {
            super::tell(format_args!("roomcast: {}", visible(&odd)));
        }
    }
    let after_restart = if answer.kept || matches!(args.action, Action::List(_)) {
        ""
    } else {
        "A restarted daemon does not know this: daemon.state keeps names.\n"
    };
    print(&format!("{}{after_restart}", listed(&answer)))
}

fn correct(who: &str, room: &str, common: &Common) -> CommandResult {
    let person: Who = who.parse().map_err(|error: TextError| Failure::usage(error.to_string()))?;
    let is_away = is_away(room);
    let text = if is_away { "away".to_owned() } else { format!("present in the {room}") };
    let event = Event::presence(&text).map_err(|error| Failure::usage(error.to_string()))?;
    let (mut config, domain) = common.asking.service.load()?;
    config.narrator.name = CORRECTIONS.to_owned();
    config.narrator.linger_s = common.asking.patience as f64;
    let known = domain.persons(Duration::from_secs(common.asking.patience))?;
    let names: Vec<String> =
        known.iter().map(|one| one.name.clone().unwrap_or_else(|| one.person.to_string())).collect();
    let mut nameable = known
        .iter()
        .map(|one| one.person.to_string())
        .chain(names.iter().cloned())
        .chain(config.persons.residents.clone());
    let asked = ReadName::new(who);
    if !nameable.any(|name| name == who || asked.may_be_one(&ReadName::new(&name))) {
        let meant = did_you_mean(who, names.iter().map(String::as_str));
        let names = if names.is_empty() { "no person yet".to_owned() } else { names.join(", ") };
        return Err(Failure::input(format!("no person {who:?}: the daemon knows {names}{meant}")));
    }
    let asker = service::Asker::new(&domain, CORRECTIONS, question::PERSON, common.asking.patience)?;
    let refused = |why: &str| Failure::input(format!("the daemon changed no belief: {why}"));
    if let Event::Present(Some(room)) = event {
        // A room that the map lacks would make the person present in any room.
        let checked: PersonAnswer = asker.ask(&PersonQuestion::Room { room: room.as_str().to_owned() })?;
        if !checked.done {
            return Err(refused(checked.reason.as_deref().unwrap_or("no reason given")));
        }
    }
    let item = Item::new(narration_kind::PRESENCE, text, person);
    let stop = service::stop()?;
    let (limits, input) = (config.daemon.intake, Input::Items(vec![item]));
    let sent = narrator::run(&config.narrator, limits, &domain, input, Pace::Seconds(0.0), &stop);
    let outcome = sent.map_err(Failure::ipc)?;
    if outcome.confirmed == 0 {
        let text =
            format!("the daemon did not confirm the correction; is a daemon running in {}?", service::shown(&domain));
        return Err(Failure::ipc(text));
    }
    let (source, epoch) = outcome.start;
    let answer: PersonAnswer = asker.ask(&PersonQuestion::Understood { source, epoch, from: 1 })?;
    if common.json {
        super::print_json(&answer)?;
    }
    match answer.understood.last().and_then(|line| line.why.as_deref()) {
        Some(why) => Err(refused(why)),
        None if common.json => Ok(()),
        None => {
            print(&format!("{who} is {}.\n", if is_away { "away".to_owned() } else { format!("in the room {room}") }))
        }
    }
}

/// Whether a place is out of the house, by the word of any output.
fn is_away(place: &str) -> bool {
    ["away", ELSEWHERE, "out"].contains(&place)
}

fn listed(answer: &PersonAnswer) -> String {
    if answer.persons.is_empty() {
        return "Nobody is known.\n".to_owned();
    }
    let mut table = table(&["person", "name", "presence", "since", "silent", ""]);
    for line in &answer.persons {
        let ago = |seconds: Option<f64>| seconds.map_or_else(String::new, duration);
        table.add_row([
            line.person.to_string(),
            line.name.clone().unwrap_or_default(),
            line.presence.as_str().to_owned(),
            ago(line.since_s),
            ago(line.silent_s),
            line.flags.iter().map(|flag| plain(flag)).collect::<Vec<_>>().join(", "),
        ]);
    }
    format!("{table}\n")
}

/// A time for people: the two largest units.
fn duration(seconds: f64) -> String {
    let seconds = seconds.max(0.0) as u64;
    match seconds {
        0..60 => format!("{seconds} s"),
        60..3600 => format!("{} min {} s", seconds / 60, seconds % 60),
        3600..86400 => format!("{} h {} min", seconds / 3600, seconds / 60 % 60),
        _ => format!("{} d {} h", seconds / 86400, seconds / 3600 % 24),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_word_for_out_of_the_house_corrects_a_place_to_away() {
        assert!(["away", "elsewhere", "out"].iter().all(|word| is_away(word)) && !is_away("outhouse"));
    }

    #[test]
    fn times_have_two_units() {
        let times = [0.0, 59.9, 61.0, 7265.0, 90_000.0].map(duration);
        assert_eq!(times, ["0 s", "59 s", "1 min 1 s", "2 h 1 min", "1 d 1 h"]);
    }
}
