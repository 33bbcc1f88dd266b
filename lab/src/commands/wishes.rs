//! `roomcast-lab wishes`: days of a household with a robot, by each way to control it.

use std::fmt::Write as _;

use strum::VariantArray as _;

use crate::experiment::wishes::{Sums, Way, play};
use roomcast_cli::{CommandResult, Failure, print, print_json, ranges};

#[derive(Debug, clap::Args)]
pub(super) struct WishesArgs {
    /// Households, each with its seed.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// Days of each.
    #[arg(long, value_name = "N", default_value_t = 14, value_parser = clap::value_parser!(u64).range(1..=366))]
    days: u64,
    /// The first seed.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = ranges::any())]
    seed: u64,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

type Column = (&'static str, fn(&Sums) -> usize);

const COLUMNS: [Column; 6] = [
    ("minutes near people", |sums| sums.near_people_min),
    ("minutes in quiet hours", |sums| sums.in_quiet_hours_min),
    ("minutes near a sleeper", |sums| sums.near_sleeper_min),
    ("starts in a short absence", |sums| sums.starts_in_short_absence),
    ("orders before knowing", |sums| sums.orders_before_knowing),
    ("rooms undone", |sums| sums.undone_room_days),
];

pub(super) fn run(args: &WishesArgs) -> CommandResult {
    let days = usize::try_from(args.days).unwrap_or(1);
    let mut rows = Vec::new();
    for way in Way::VARIANTS {
        let sums = (0..args.seeds).map(|more| play(*way, days, args.seed.wrapping_add(more)));
        let sums = sums.collect::<Result<Vec<_>, _>>().map_err(Failure::failed)?;
        rows.push((<&str>::from(way), sums));
    }
    if args.json {
        let each = rows.iter().map(|(way, sums)| (way, sums)).collect::<std::collections::BTreeMap<_, _>>();
        return print_json(&each);
    }
    let mut text = format!(
        "A household and day, mean of {} households of {days} days\n\n| | {} |\n|---|{}\n",
        args.seeds,
        COLUMNS.map(|(name, _)| name).join(" | "),
        "---:|".repeat(COLUMNS.len())
    );
    for (way, sums) in &rows {
        let per_day = (args.seeds as usize * days) as f64;
        let mean = |of: fn(&Sums) -> usize| sums.iter().map(of).sum::<usize>() as f64 / per_day;
        let values = COLUMNS.map(|(_, of)| format!("{:.2}", mean(of))).join(" | ");
        let _ = writeln!(text, "| {way} | {values} |");
    }
    print(&text)
}
