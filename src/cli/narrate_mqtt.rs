//! `roomcast narrate --mqtt`: rules turn messages of a broker into events.

use std::path::Path;
use std::thread::JoinHandle;
use std::time::Duration;

use roomcast_core::grounding::Grounding;
use roomcast_core::places::PlaceMatcher;
use roomcast_services::clock;
use roomcast_services::config::Config;
use roomcast_services::daemon::{Persons, PersonsFile};
use roomcast_services::dry_run::DryRun;
use roomcast_services::mqtt::tally::Tally;
use roomcast_services::mqtt::{self, Broker, Heard, MqttError, Rules};
use roomcast_services::narrator::{Input, Who, line_item};
use roomcast_services::setup;
use roomcast_services::stop::Stop;

use super::doctor::Remarks;
use super::{CommandResult, Failure, broker, count, print, print_json_line};

const TICK: Duration = Duration::from_millis(100);
/// After a stop, the time for publishing and confirming the lines that were read.
const PATIENCE: Duration = Duration::from_secs(5);

/// Listens to the broker in a thread. Lines come through a pipe with a small buffer, which blocks the thread while the daemon is behind. The broker
/// keeps messages until the daemon has confirmed them.
pub(super) fn listen(
    broker: &Broker,
    rules: &Path,
    person: Who,
    config: &Config,
    stop: &Stop,
) -> Result<(Input, Listener), Failure> {
    let rules = Rules::load(rules).map_err(broker::failure)?;
    let options = broker.options().map_err(broker::failure)?;
    let state = config.daemon.state_directory();
    let tally = state.map(|folder| Tally::new(&folder, &config.narrator.name, rules.keys()));
    let (reader, writer) = std::io::pipe().map_err(Failure::failed)?;
    // The smallest size, a page. If the system refuses, it stays larger.
    let _resized = rustix::pipe::fcntl_setpipe_size(&writer, 4096);
    let (stop, (settled, news)) = (stop.clone(), mqtt::settled());
    let listener = std::thread::Builder::new().name("mqtt".to_owned());
    let listener = listener
        .spawn(move || mqtt::listen_until_settled(options, rules, tally, writer, news, &stop))
        .map_err(|error| Failure::failed(format!("cannot start the mqtt thread: {error}")))?;
    let (name, stream) = (broker.address.clone(), Box::new(reader));
    Ok((Input::Lines { name, stream, person, settled: Some(settled) }, listener))
}

/// Prints the lines of the broker's messages until asked to stop, and reports rooms and things that the home's map lacks, and unknown persons. No
/// daemon is needed.
pub(super) fn rehearse(broker: &Broker, rules: &Path, _: &Who, config: &Config, stop: &Stop) -> CommandResult {
    let rules = Rules::load(rules).map_err(broker::failure)?;
    let options = broker.options().map_err(broker::failure)?;
    // The included studio is not this home: its rooms do not matter for the rules.
    let map = config.scene.path.as_deref().map(|path| setup::load_map(Some(path))).transpose()?;
    let grounding = map.as_ref().map(|map| Grounding::new(map, &config.grounding)).transpose();
    let grounding = grounding.map_err(Failure::config)?;
    let home = map.as_ref().zip(grounding.as_ref());
    let home = home.map(|(map, grounding)| (map, PlaceMatcher::new(map, grounding)));
    let names = config.daemon.state_directory().map_or_else(PersonsFile::default, |state| PersonsFile::load(&state));
    let persons = Persons::new(config.persons.clone(), names);
    let mut remarks = Remarks { persons, residents: &config.persons.residents, home };
    let mut remark = |line: &str| remarks.on(line);
    let heard = mqtt::rehearse(options, rules, std::io::stdout(), stop, &mut remark).map_err(broker::failure)?;
    let Heard { said, unfit, silent, unsayable, oversized } = heard;
    let summary = format!(
        "would be said: {}; messages that no rule speaks of: {unfit}, that say nothing new: {silent}, whose words are no narration: {unsayable}, \
         that are too large: {oversized}\n",
        count(usize::try_from(said).unwrap_or(usize::MAX), "line")
    );
    print(&summary)
}

/// Prints how the daemon would understand each event of the broker's messages, a line of JSON each.
pub(super) fn rehearse_as_json(
    broker: &Broker,
    rules: &Path,
    person: &Who,
    config: &Config,
    stop: &Stop,
) -> CommandResult {
    let rules = Rules::load(rules).map_err(broker::failure)?;
    let options = broker.options().map_err(broker::failure)?;
    let mut dry_run = DryRun::new(config, clock::unix_ns()).map_err(Failure::config)?;
    let mut fault = None;
    let mut print = |line: &str| {
        let item = line_item(line, person).ok()?;
        let shown = dry_run.take(&item).map_err(Failure::config).transpose()?.and_then(|line| print_json_line(&line));
        if let Err(error) = shown {
            fault = Some(error);
            stop.request();
        }
        None
    };
    mqtt::rehearse(options, rules, std::io::sink(), stop, &mut print).map_err(broker::failure)?;
    fault.map_or(Ok(()), Err)
}

/// A stop that follows the given one after [`PATIENCE`].
pub(super) fn patience(stop: &Stop) -> Result<Stop, Failure> {
    let (first, last) = (stop.clone(), Stop::new());
    let own = last.clone();
    let wait = move || {
        while !first.requested() {
            std::thread::sleep(TICK);
        }
        std::thread::sleep(PATIENCE);
        own.request();
    };
    let waiting = std::thread::Builder::new().name("patience".to_owned()).spawn(wait);
    waiting.map_err(|error| Failure::failed(format!("cannot start a thread: {error}")))?;
    Ok(last)
}

pub(super) type Listener = JoinHandle<Result<Heard, MqttError>>;

/// The end of the listener. It ends by itself only if the client cannot go on.
pub(super) fn join(listener: Listener) -> CommandResult {
    let heard = listener.join().map_err(|_| Failure::failed("the mqtt thread ended unexpectedly"))?;
    let heard = heard.map_err(broker::failure)?;
    let Heard { said, unfit, silent, unsayable, oversized } = heard;
    tracing::info!(said, unfit, silent, unsayable, oversized, "left the broker");
    Ok(())
}
