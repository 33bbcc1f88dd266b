//! `roomcast-lab persons`: the tracker's score in simulated homes with sensors.

use std::path::PathBuf;
use std::sync::Arc;

use clap::builder::{PossibleValuesParser, TypedValueParser};
use strum::VariantNames;

use super::maps;
use crate::experiment::persons::{self, Method, Row, Setup, ahead};
use crate::experiment::report::Table;
use crate::experiment::{Progress, prediction};
use crate::home_simulation::days::VISITS;
use crate::home_simulation::plan::Device;
use crate::home_simulation::recorded::Recorded;
use roomcast_cli::{Column, CommandResult, Failure, print, print_json, ranges};
use roomcast_core::tracker::Options;

/// Most residents of a simulated home.
const RESIDENTS_MAX: usize = 4;
/// Most residents of the exact filter.
const EXACT_MAX: usize = 2;
/// Most days of one row.
const DAYS_MAX: usize = 10_000;

#[derive(Debug, clap::Args)]
pub(super) struct PersonsArgs {
    /// Days per row. A home lives for ten days, then another begins.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = ranges::whole(1..=DAYS_MAX))]
    days: usize,
    /// Residents, 1 to 4; all four when left out.
    #[arg(long, value_name = "N", value_parser = ranges::whole(1..=RESIDENTS_MAX), conflicts_with = "household")]
    residents: Option<usize>,
    /// Seed of homes, days and devices: the same seed gives the same table.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = ranges::any())]
    seed: u64,
    /// Kinds of devices that the homes lack. When left out, the table has homes with all devices, without beds and without beds and presence sensors.
    #[arg(long, value_name = "KINDS", value_delimiter = ',',
        value_parser = PossibleValuesParser::new(Device::VARIANTS).try_map(|name| name.parse::<Device>()))]
    without: Option<Vec<Device>>,
    /// A cat lives there and sets off motion sensors.
    #[arg(long)]
    pet: bool,
    /// Share of days with one or two guests.
    #[arg(long, value_name = "SHARE", default_value_t = VISITS, value_parser = ranges::share)]
    visits: f64,
    /// Most joint states that the filter keeps.
    #[arg(long, value_name = "N", default_value_t = Options::default().states, value_parser = ranges::whole(2..=100_000_usize))]
    states: usize,
    /// Slots of the filter for unknown persons.
    #[arg(long, value_name = "N", default_value_t = Options::default().unknown, value_parser = ranges::whole(0..=4_usize))]
    unknown: usize,
    /// The forecast of later places instead: of one home for all days, by the filter and by the daemon.
    #[arg(long, conflicts_with_all = ["household", "programs", "exact"])]
    ahead: bool,
    /// Also run the filter that keeps every joint state, in homes of one or two: minutes for each day of two residents.
    #[arg(long)]
    exact: bool,
    /// A folder of days in HOMER+'s format, once per resident, in place of written days.
    #[arg(long, value_name = "FOLDER", requires = "scene")]
    household: Vec<PathBuf>,
    /// A folder of activity programs (VirtualHome) in place of written days.
    #[arg(long, value_name = "FOLDER", requires = "scene", conflicts_with = "household")]
    programs: Option<PathBuf>,
    /// The scene of these days: a scene file, the name of a shipped scene, or a VirtualHome graph (*_graph.json).
    #[arg(long, value_name = "FILE")]
    scene: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &PersonsArgs) -> CommandResult {
    let residents: Vec<usize> = match (args.residents, args.household.len()) {
        (Some(residents), _) => vec![residents],
        (None, 0) => (1..=RESIDENTS_MAX).collect(),
        (None, households) => vec![households],
    };
    let lacks: Vec<Vec<Device>> = match &args.without {
        Some(without) => vec![without.clone()],
        None => vec![Vec::new(), vec![Device::Bed], vec![Device::Bed, Device::Presence]],
    };
    if args.exact && residents.iter().any(|residents| *residents > EXACT_MAX) {
        let fault = format!("--exact is for at most {EXACT_MAX} residents: give --residents {EXACT_MAX}");
        return Err(Failure::usage(fault));
    }
    let methods = [Method::Tracker, Method::Exact, Method::Assigned, Method::LastSensor];
    let methods: Vec<Method> = methods.into_iter().filter(|own| *own != Method::Exact || args.exact).collect();
    let progress = Progress::new("homes", residents.len() * lacks.len() * args.days.div_ceil(10));
    let (mut rows, mut later) = (Vec::new(), Vec::new());
    for residents in residents {
        let recorded = recorded(args, residents)?.map(Arc::new);
        for without in &lacks {
            let setup = Setup {
                residents,
                without: without.clone(),
                days: args.days,
                seed: args.seed,
                pet: args.pet,
                visits: args.visits,
                tracker: Options { states: args.states, unknown: args.unknown, ..Options::default() },
                recorded: recorded.clone(),
            };
            if args.ahead {
                later.extend(ahead::run(&setup).map_err(Failure::input)?);
                continue;
            }
            rows.extend(persons::run(&setup, &methods, || progress.step()).map_err(Failure::input)?);
        }
    }
    drop(progress);
    match (args.ahead, args.json) {
        (true, true) => print_json(&serde_json::json!({"seed": args.seed, "rows": later})),
        (true, false) => print(&text_ahead(&later)),
        (false, true) => print_json(&serde_json::json!({"seed": args.seed, "rows": rows})),
        (false, false) => print(&text(&rows)),
    }
}

fn recorded(args: &PersonsArgs, residents: usize) -> Result<Option<Recorded>, Failure> {
    let Some(scene) = args.scene.as_ref().filter(|_| args.programs.is_some() || !args.household.is_empty()) else {
        return Ok(None);
    };
    let maps = maps(std::slice::from_ref(scene))?;
    let Some((map, grounding)) = maps.first() else { return Ok(None) };
    let mut own = Recorded::new(map, grounding).map_err(Failure::input)?;
    for folder in &args.household {
        own.add_days(&roomcast_cli::days::read(folder)?, map, grounding);
    }
    if let Some(folder) = &args.programs {
        let programs = prediction::load_programs(folder)?;
        let programs: Vec<_> = programs.into_iter().map(|named| named.program).collect();
        for resident in 0..residents {
            own.add_programs(&programs, args.days, map, grounding, args.seed.wrapping_add(resident as u64));
        }
    }
    if own.residents.iter().any(Vec::is_empty) {
        let fault =
            format!("the scene `{}` has none of the things of these days: give the scene they belong to", map.name());
        return Err(Failure::input(fault));
    }
    Ok(Some(own))
}

fn text_ahead(rows: &[ahead::Row]) -> String {
    let columns: [Column<'_, ahead::Row>; 6] = [
        ("residents", &|row| row.residents.to_string()),
        ("without", &|row| row.without.join(", ")),
        ("ahead, s", &|row| row.ahead_s.to_string()),
        ("method", &|row| row.method.to_owned()),
        ("loss, nats", &|row| format!("{:.4}", row.log_loss_nats)),
        ("loss of a room, nats", &|row| row.occupied_nats.map_or_else(String::new, |nats| format!("{nats:.4}"))),
    ];
    Table::of("", "", rows, &columns).text() + "\n"
}

fn text(rows: &[Row]) -> String {
    let columns: [Column<'_, Row>; 14] = [
        ("residents", &|row| row.residents.to_string()),
        ("without", &|row| row.without.join(", ")),
        ("method", &|row| <&str>::from(row.method).to_owned()),
        ("right %", &|row| format!("{:.1}", 100.0 * row.right)),
        ("rooms %", &|row| format!("{:.1}", 100.0 * row.rooms)),
        ("with 1, 2 visitors", &|row| row.rooms_visited.map(|rooms| format!("{:.1}", 100.0 * rooms)).join(", ")),
        ("loss, nats", &|row| format!("{:.3}", row.log_loss_nats)),
        ("calibration", &|row| format!("{:.3}", row.calibration_error)),
        ("wrong > .9, %", &|row| format!("{:.2}", 100.0 * row.wrong_and_sure)),
        ("empty while in, of 10 000 min", &|row| format!("{:.1}", row.empty_while_in)),
        ("loss at +15 min", &|row| row.forecast_nats.map_or_else(String::new, |nats| format!("{nats:.3}"))),
        ("robot beside, min/h", &|row| format!("{:.2}", row.beside_min_per_h)),
        ("rooms done, %", &|row| format!("{:.1}", 100.0 * row.rooms_done)),
        ("us a report", &|row| format!("{:.0}", row.report_us)),
    ];
    Table::of("", "", rows, &columns).text() + "\n"
}
