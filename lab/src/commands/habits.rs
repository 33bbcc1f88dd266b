//! `roomcast-lab habits`: how well a home is learned, day by day.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

use super::{LikeThingsArgs, ModelArgs, embedded_statistics, in_file, maps, report_first_faults};
use crate::experiment::chart::{Chart, Mark, Series};
use crate::experiment::habits::cleaning::{self, Less};
use crate::experiment::habits::{
    self, ALL, Days, Difference, HALF, Options, PREDICTORS, Report, Row, Sets, TARGETS, UNSEEN,
};
use crate::experiment::losses::{Figure, shown};
use crate::experiment::report::{Report as Page, Table};
use crate::experiment::{Progress, distinct};
use roomcast_cli::choice::choice;
use roomcast_cli::{Column, CommandResult, Failure, count, print, print_json, ranges, tell_unfit};
use roomcast_core::grounding::Grounding;
use roomcast_core::habits::{HabitsOptions, Without};
use roomcast_core::narration::Event;
use roomcast_core::places::PlaceMatcher;
use roomcast_core::prompt::BindingSequence;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_ipc::raw::narration_kind;
use roomcast_services::message_text::event_of;
use roomcast_services::narrator::{Item, Who};
use roomcast_services::sensor_log::{Absences, Said as Narrated, SensorRules, absences};
use roomcast_simulation::binding::ItemChoice;
use roomcast_simulation::homer::Day;
use roomcast_simulation::trace::{Interval, Step, Trace};

#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("watched").required(true).args(["days", "sensors"])))]
pub(super) struct HabitsArgs {
    /// A folder of days (HOMER+), learned in the order of their names.
    #[arg(long, value_name = "FOLDER", conflicts_with_all = ["rules", "presence"])]
    days: Option<PathBuf>,
    /// A log of sensors, as docs/sensors.md describes it.
    #[arg(long, value_name = "LOG", requires = "rules")]
    sensors: Option<PathBuf>,
    /// The rules that give the sensors' intervals in words.
    #[arg(long, value_name = "RULES", requires = "sensors")]
    rules: Option<PathBuf>,
    /// Intervals of absence from home: start, end and, if the log has other intervals as well, a label ("away", "leave house", "going out
    /// to work").
    #[arg(long, value_name = "INTERVALS", requires = "sensors")]
    presence: Option<PathBuf>,
    /// A scene file, or the name of a shipped scene.
    #[arg(long, value_name = "FILE")]
    scene: PathBuf,
    /// The choice among a label's items for an object of a day, if the map has no item of its number.
    #[arg(long, value_parser = choice::<ItemChoice>(), default_value_t = ItemChoice::First, conflicts_with_all = ["sensors", "rules", "presence"])]
    items: ItemChoice,
    /// Days after which an observation has half its weight; 0 for never.
    #[arg(long, value_name = "DAYS", default_value_t = HabitsOptions::default().half_life_days, value_parser = ranges::time_s)]
    half_life: f64,
    /// The binding sequence: default, p0 to p5, or a text of your own.
    #[arg(long, value_name = "TEXT", default_value = "default")]
    binding: BindingSequence,
    /// Measure the mixture without a part of it, too, or without several at once (joined by commas); "each" leaves out each part in turn. May
    /// be given several times.
    #[arg(long, value_name = "PARTS")]
    without: Vec<String>,
    #[command(flatten)]
    like_things: LikeThingsArgs,
    #[command(flatten)]
    model: ModelArgs,
    /// Write a report with pictures of the learning curves into this folder.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &HabitsArgs) -> CommandResult {
    let (map, grounding) = maps(std::slice::from_ref(&args.scene))?.remove(0);
    let statistics = embedded_statistics()?;
    let trace = match (&args.days, &args.sensors, &args.rules) {
        (Some(folder), ..) => of_days(&roomcast_cli::days::read(folder)?, &map, &grounding, args)?,
        (None, Some(log), Some(rules)) => sensors(log, rules, args.presence.as_deref(), &map, &grounding)?,
        _ => return Err(Failure::usage("give --days, or --sensors with --rules")),
    };
    // An unwritable folder is reported before the work.
    if let Some(folder) = &args.out {
        std::fs::create_dir_all(folder).map_err(|error| {
            let text = format!("failed to make {}: {error}; choose another folder with --out", folder.display());
            Failure::failed(text)
        })?;
    }
    let mut source = args.model.source(&grounding)?;
    let options = Options {
        history: args.model.limits(),
        binding: args.binding.clone(),
        habits: HabitsOptions { half_life_days: args.half_life, ..HabitsOptions::default() },
        forecast: args.like_things.options(),
        without: reduced(&args.without)?,
        seed: args.model.seed,
    };
    let progress = Progress::new("sentences", trace.steps.len());
    let report = habits::run(&trace, (&map, &grounding), &mut source, &statistics, &options, &progress)?;
    drop(progress);
    if report.rows.is_empty() {
        let text = "nothing could be measured: no thing is followed by another, and no place is known for a minute and the one after it; give a longer log";
        return Err(Failure::input(text));
    }
    let page = page(&report, map.name());
    if let Some(folder) = &args.out {
        page.write(folder)?;
    }
    if args.json { print_json(&report) } else { print(&page.text()) }
}

fn of_days(days: &[Day], map: &SemanticMap, grounding: &Grounding, args: &HabitsArgs) -> Result<Trace, Failure> {
    let trace = Trace::of_days(days, map, grounding, args.items, args.model.seed)?;
    let actions = days.iter().flat_map(|day| &day.actions);
    let mut unknown = BTreeMap::new();
    for (action, _) in actions.zip(&trace.steps).filter(|(_, step)| step.lacking) {
        let object = action.action.objects().first().map_or_else(String::new, |object| object.name.clone());
        *unknown.entry(object).or_default() += 1;
    }
    report_unknown("actions are with things that the scene lacks", trace.steps.len(), &unknown);
    Ok(trace)
}

fn read(path: &Path) -> Result<Vec<u8>, Failure> {
    std::fs::read(path).map_err(|error| Failure::input(format!("failed to read {}: {error}", path.display())))
}

/// Reports words without a place in the scene, and their counts, the most frequent first.
fn report_unknown(what: &str, of: usize, unknown: &BTreeMap<String, usize>) {
    const SHOWN: usize = 5;
    let times: usize = unknown.values().sum();
    if times == 0 {
        return;
    }
    let mut words: Vec<_> = unknown.iter().collect();
    words.sort_by_key(|(_, times)| std::cmp::Reverse(**times));
    let shown: Vec<_> = words.iter().take(SHOWN).map(|(word, times)| format!("{word} ({times})")).collect();
    let more = if words.len() > SHOWN { ", ..." } else { "" };
    roomcast_cli::tell(format_args!("roomcast: {times} of {of} {what}: {}{more}", shown.join(", ")));
}

fn sensors(
    log: &Path,
    rules: &Path,
    presence: Option<&Path>,
    map: &SemanticMap,
    grounding: &Grounding,
) -> Result<Trace, Failure> {
    let rules = SensorRules::load(rules).map_err(Failure::input)?;
    let narrated = rules.narrate_file(log, &Who::Somebody).map_err(Failure::input)?;
    report_first_faults(narrated.faults.told(), narrated.faults.count());
    tell_unfit(&narrated);
    let partition = |room: u32| grounding.partitions().iter().position(|p| p.rooms.iter().any(|id| id.0 == room));
    let place = |words: &str| map.find_room(&words.replace('_', " ").to_lowercase()).and_then(|room| partition(room.0));
    let read_intervals = rules.intervals(&read(log)?);
    if read_intervals.is_empty() {
        let fault_text = "it has no interval that can be read; docs/sensors.md shows what they look like";
        return Err(in_file(log, fault_text));
    }
    let mut unknown = BTreeMap::new();
    // A sensor without a place has no unknown place.
    for interval in read_intervals.iter().filter(|own| !own.place.is_empty() && place(&own.place).is_none()) {
        *unknown.entry(format!("{:?}", interval.place)).or_default() += 1;
    }
    report_unknown("intervals are in places that are no rooms of the scene", read_intervals.len(), &unknown);
    let intervals: Vec<Interval> = (read_intervals.iter())
        .map(|interval| Interval { from_s: interval.start_s, to_s: interval.end_s, room: place(&interval.place) })
        .collect();
    if intervals.iter().all(|interval| interval.room.is_none()) {
        let fault_text =
            "no interval is in a room of the scene: name the column of places in the rules, and the rooms in the scene";
        return Err(in_file(log, fault_text));
    }
    let mut mentions = PlaceMatcher::new(map, grounding);
    let weights = grounding.weights();
    let mut steps = Vec::new();
    for Narrated { item, at_s, interval, .. } in &narrated.said {
        let Ok(Event::Did(sentence)) = event_of(item.kind, &item.text) else { continue };
        let label = mentions.last(sentence.as_str()).filter(|found| !found.is_left).map(|found| found.label);
        let own = intervals.get(*interval).and_then(|interval| interval.room);
        let of_interval = own.filter(|room| label.is_none_or(|label| weights[(label, *room)] > 0.0));
        let only = label.and_then(|label| (0..weights.columns()).find(|room| weights[(label, *room)] > 0.999));
        steps.push(Step { at_s: *at_s, sentence, label, room: of_interval.or(only), lacking: false, unseen: false });
    }
    let taken_for_one = taken_for_one(narrated.said.iter().map(|said| &said.item));
    for remark in missing(&steps).into_iter().chain(taken_for_one) {
        roomcast_cli::tell(format_args!("roomcast: {remark}"));
    }
    let away = match presence {
        Some(path) => absences(&read(path)?).map_err(|error| in_file(path, error))?,
        None => Absences::default(),
    };
    tell_absences(&away);
    Ok(Trace::of_sensors(steps, &intervals, &away.intervals, grounding.partitions().len())?)
}

/// A remark on rules about several people or absences: the log is treated as one person's.
fn taken_for_one<'a>(items: impl Iterator<Item = &'a Item>) -> Option<&'static str> {
    let (mut persons, mut is_out) = (HashSet::new(), false);
    for item in items {
        persons.insert(&item.person);
        is_out |= item.kind == narration_kind::PRESENCE && ["away", "gone"].contains(&item.text.as_str());
    }
    match (persons.len() > 1, is_out) {
        (true, _) => Some(
            "the log is measured as that of one person: the rules' `person` and `presence` count for nothing here; give the log of one, and --presence \
             for when they were out",
        ),
        (false, true) => {
            Some("the rules' `presence` counts for nothing here: give --presence for when the person was out")
        }
        (false, false) => None,
    }
}

/// The measure that is impossible with these steps, and a remedy.
fn missing(steps: &[Step]) -> Option<&'static str> {
    if steps.is_empty() {
        return Some(
            "no sentence is said of any interval: rooms at times ahead are measured, next things and next rooms are not; give rules with `say` for these",
        );
    }
    steps.iter().all(|step| step.label.is_none()).then_some(
        "no sentence mentions a thing of the scene: next things are not measured; give the scene these things, or aliases",
    )
}

fn tell_absences(Absences { intervals, labels, others }: &Absences) {
    if labels.is_empty() {
        return;
    }
    let labels: Vec<_> = labels.iter().map(|(label, times)| format!("{label:?} ({times})")).collect();
    let (absences, others) = (count(intervals.len(), "absence"), count(*others, "interval"));
    roomcast_cli::tell(format_args!("roomcast: {absences} by {}; {others} with other words", labels.join(", ")));
}

/// The mixtures that lack some parts.
fn reduced(given: &[String]) -> Result<Vec<(String, Without)>, Failure> {
    let each = || Without::names().map(str::to_owned).collect();
    let given = given.iter().flat_map(|names| if names == "each" { each() } else { vec![names.clone()] });
    let without = |names: String| {
        let mut without = Without::default();
        for name in names.split(',') {
            without = without.and(name).ok_or_else(|| {
                let all = Without::names().collect::<Vec<_>>().join(", ");
                Failure::usage(format!("the mixture has no part {name:?}; its parts are {all}"))
            })?;
        }
        Ok((format!("-{names}"), without))
    };
    given.map(without).collect()
}

/// The change of each target in nats when a part is left out, with intervals by day.
fn ablation(report: &Report) -> Table {
    let all = || report.differences.iter().filter(|d| d.day == ALL && d.less.starts_with('-'));
    let cell = |name: &str, target: &str| match all().find(|d| d.less == name && d.target == target) {
        Some(d) => shown((-d.nll_nats, Some([-d.nll_ci95[1], -d.nll_ci95[0]])), 4),
        None => String::new(),
    };
    let header = std::iter::once("without").chain(TARGETS);
    let mut table = Table::new("ablation", "Loss without a part, less that of the whole mixture (nats)", header);
    let row = |name: &str| {
        let cells = TARGETS.map(|target| cell(name, target));
        std::iter::once(name[1..].to_owned()).chain(cells).collect()
    };
    table.rows = distinct(all().map(|d| d.less.as_str())).into_iter().map(row).collect();
    table
}

fn tables(report: &Report) -> Vec<Table> {
    let less = |row: &Row| {
        let own = |d: &&Difference| (d.day, d.target, &d.less) == (row.day, row.target, &row.predictor);
        report.differences.iter().find(own)
    };
    let is_whole = |row: &&Row| !row.predictor.starts_with('-');
    let stretch = |day| report.rows.iter().filter(is_whole).filter(move |row| row.day == day);
    let columns: [Column<'_, Row>; 10] = [
        ("days", &|row| match row.day {
            Days::One(day) => day.to_string(),
            Days::Some(name) => name.to_owned(),
        }),
        ("target", &|row| row.target.to_owned()),
        ("predictor", &|row| row.predictor.clone()),
        ("cases", &|row| row.n.to_string()),
        ("nll (nats)", &|row| shown((row.nll_nats, row.ci95.map(|ci95| ci95.nll_nats)), 3)),
        ("top-1", &|row| shown((row.top1, row.ci95.map(|ci95| ci95.top1)), 3)),
        ("mrr", &|row| format!("{:.3}", row.mrr)),
        ("brier", &|row| format!("{:.3}", row.brier)),
        ("ece", &|row| format!("{:.3}", row.ece)),
        ("mixture less this (nats)", &|row| {
            less(row).map_or_else(String::new, |less| shown((less.nll_nats, Some(less.nll_ci95)), 3))
        }),
    ];
    let rows = [ALL, HALF, UNSEEN].into_iter().flat_map(stretch);
    let all = Table::of("habits", "All days, and the second half of them", rows, &columns);
    let columns: [Column<'_, Sets>; 7] = [
        ("horizon (s)", &|row| format!("{:.0}", row.horizon_s)),
        ("asked", &|row| format!("{:.2}", row.coverage_asked)),
        ("held", &|row| format!("{:.3}", row.coverage)),
        ("places", &|row| format!("{:.2}", row.size_mean)),
        ("places, shipped forecast", &|row| format!("{:.2}", row.size_mean_shipped)),
        ("held, never empty", &|row| format!("{:.3}", row.coverage_never_empty)),
        ("places, never empty", &|row| format!("{:.2}", row.size_mean_never_empty)),
    ];
    let sets = Table::of("sets", "Sets of places with a promise", &report.sets, &columns);
    let tables = [all, sets, cleaning(report), ablation(report)].into_iter();
    tables.filter(|table| table.name != "ablation" || !table.rows.is_empty()).collect()
}

fn cleaning(report: &Report) -> Table {
    let less =
        |row: &cleaning::Row, of: fn(Less) -> Figure| row.less.map(|less| shown(of(less), 3)).unwrap_or_default();
    let columns: [Column<'_, cleaning::Row>; 6] = [
        ("forecast", &|row| row.predictor.to_owned()),
        ("policy", &|row| row.policy.to_owned()),
        ("disturbance (s/h)", &|row| format!("{:.1}", row.disturbance_s_per_h)),
        ("less", &|row| less(row, |less| (less.disturbance_s_per_h, less.disturbance_ci95))),
        ("coverage", &|row| format!("{:.3}", row.coverage)),
        ("less", &|row| less(row, |less| (less.coverage, less.coverage_ci95))),
    ];
    let title = "Rounds of a robot, planned against the forecast without habits (model) and with them (mixture)";
    Table::of("cleaning", title, &report.cleaning, &columns)
}

fn curve(report: &Report, target: &str) -> Chart {
    let shown = ["mixture", "without-model", "model", "counts", "stay", "persistence"];
    let series = PREDICTORS.iter().filter(|name| shown.contains(name)).map(|name| {
        let days = report.rows.iter().filter(|row| row.predictor == *name && row.target == target);
        let points = days.filter_map(|row| match row.day {
            Days::One(day) => Some((day as f64, row.nll_nats)),
            Days::Some(_) => None,
        });
        Series { name: (*name).to_owned(), points: points.collect(), mark: Mark::Line }
    });
    Chart {
        title: format!("Learning a home: {target}"),
        x: "day".into(),
        y: "loss (nats)".into(),
        series: series.collect(),
    }
}

fn page(report: &Report, scene: &str) -> Page {
    let figures = TARGETS.iter().filter(|target| report.rows.iter().any(|row| row.target == **target));
    Page {
        title: format!("Learning a home: {scene}"),
        notes: vec![notes(report)],
        tables: tables(report),
        figures: figures.map(|target| (format!("habits-{target}"), curve(report, target).svg())).collect(),
    }
}

fn notes(report: &Report) -> String {
    let learned = &report.learned;
    format!(
        "{} over {}; each is forecast first and learned from then. {} of {} in {} bytes. 95 % intervals by bootstrap over days.",
        count(report.cases, "case"),
        count(report.days, "day"),
        count(learned.counts, "count"),
        count(learned.names, "thing"),
        learned.bytes,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Several people and absences in a log's rules give a remark.
    #[test]
    fn a_log_of_several_people_is_told_to_be_measured_as_one() {
        let remark = |rules: &str| {
            let log = b"0,5,hall,PIR,Hall\n100,110,ada,phone,\n";
            let said = SensorRules::parse(rules).unwrap().narrate(log, &Who::Somebody).said;
            taken_for_one(said.iter().map(|said| &said.item))
        };
        let moves = "[[rule]]\nkind = \"PIR\"\nsay = \"They walk to the {place}.\"\n";
        let phone = "[[rule]]\nkind = \"phone\"\npresence = \"away\"\n";
        assert_eq!(remark(moves), None);
        assert!(remark(&format!("{moves}{phone}")).unwrap().contains("--presence"));
        assert!(remark(&format!("{moves}{phone}person = \"{{sensor}}\"")).unwrap().contains("of one person"));
    }
}
