//! The phase of the planner between its decisions, and the steps from phase to phase.

use super::rules::Reason;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Phase {
    /// The last decision is done, or is the work in hand.
    Free,
    /// An earlier planner ordered the work in hand. This planner repeats the order, so that the robot knows its number.
    Resumes,
    Pauses(Pause),
    /// The fallback, which is valid until scores are fresh.
    FellBack,
    /// To stay, because every room is covered.
    Finished,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Pause {
    Battery,
    /// A person has come into its room, and persons are in the others.
    Persons,
    /// It fails at each order.
    Trouble,
    /// No room is open to it.
    NoRoom,
    /// Rooms of persons' sets are avoided, and the sets of the scores have not come.
    NoSets,
    /// A rule of the house, by its kind.
    Rule(std::mem::Discriminant<Reason>),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Step {
    /// The work of an earlier planner is in hand again.
    Restore,
    /// A person's order has come or expired, or a rule has ended the work.
    Order,
    /// A silent robot counts as charged.
    Charge,
    /// Scores are fresh, and a decision is due.
    Decide,
    Go,
    Pause(Pause),
    FallBack,
    Finish,
}

impl Phase {
    pub(super) fn after(self, step: Step) -> Self {
        match (self, step) {
            (_, Step::Restore) | (Self::Resumes, Step::Order) => Self::Resumes,
            (Self::Pauses(why), Step::Decide) | (_, Step::Pause(why)) => Self::Pauses(why),
            (_, Step::FallBack) => Self::FellBack,
            (_, Step::Finish) => Self::Finished,
            (_, Step::Order | Step::Charge | Step::Decide | Step::Go) => Self::Free,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TABLE: &str = "\
phase    | Restore | Order   | Charge  | Decide  | Go      | Pause   | FallBack | Finish
Free     | Resumes | Free    | Free    | Free    | Free    | Pauses  | FellBack | Finished
Resumes  | Resumes | Resumes | Free    | Free    | Free    | Pauses  | FellBack | Finished
Pauses   | Resumes | Free    | Free    | Pauses  | Free    | Pauses  | FellBack | Finished
FellBack | Resumes | Free    | Free    | Free    | Free    | Pauses  | FellBack | Finished
Finished | Resumes | Free    | Free    | Free    | Free    | Pauses  | FellBack | Finished
";

    /// The row is the phase before a step, the column the step, the cell the phase after it.
    #[test]
    fn each_phase_has_one_next_phase_per_step() {
        let why = Pause::NoRoom;
        let (restore, charge) = (Step::Restore, Step::Charge);
        let steps =
            [restore, Step::Order, charge, Step::Decide, Step::Go, Step::Pause(why), Step::FallBack, Step::Finish];
        let name = |value: String| value.split('(').next().unwrap_or_default().to_owned();
        let row = |head: String, cells: Vec<String>| {
            let cells = cells.iter().map(|cell| format!(" | {cell:7}")).collect::<String>();
            format!("{}\n", format!("{head:8}{cells}").trim_end())
        };
        let mut table = row("phase".to_owned(), steps.map(|step| name(format!("{step:?}"))).to_vec());
        for phase in [Phase::Free, Phase::Resumes, Phase::Pauses(why), Phase::FellBack, Phase::Finished] {
            let cells = steps.map(|step| name(format!("{:?}", phase.after(step))));
            table += &row(name(format!("{phase:?}")), cells.to_vec());
        }
        println!("{table}");
        assert_eq!(table, TABLE);
    }
}
