//! The words and the chart of `roomcast demo`.

use roomcast_core::narration::action_table;
use roomcast_ipc::raw::DecisionV1;
use roomcast_simulation::world::Stay;

pub(super) const NAME: &str = "Ada";

/// A narrated sentence as people say it: "They drink the mug." is "Ada drinks from the mug.". The model was trained on the narrated words.
pub(super) fn told(sentence: &str) -> String {
    let Some(rest) = sentence.strip_prefix("They ") else { return sentence.to_owned() };
    let (verb, rest) = rest.split_at(rest.find([' ', '.']).unwrap_or(rest.len()));
    let third = action_table().values().find(|entry| entry.base == verb).map_or(verb, |entry| entry.third.as_str());
    let is_vessel = ["mug", "cup", "glass", "bottle"].iter().any(|vessel| rest == format!(" the {vessel}."));
    let rest = match verb {
        "drink" if is_vessel => format!(" from{rest}"),
        "put" => rest.replacen(" on the dishwasher", " into the dishwasher", 1),
        _ => rest.to_owned(),
    };
    format!("{NAME} {third}{rest}")
}

pub(super) fn reason(decision: &DecisionV1) -> String {
    sentences(decision.reason())
}

fn sentences(text: &str) -> String {
    let capital = |sentence: &str| {
        let mut letters = sentence.chars();
        letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
    };
    let text = text.trim_end_matches('.').split(". ").map(capital).collect::<Vec<String>>().join(". ");
    if text.is_empty() { text } else { text + "." }
}

/// Where person and robot were, a row a room: the robot in the upper half of a cell, the person in the lower.
pub(super) fn chart(names: &[String], person: &[usize], stays: &[Stay], columns: usize) -> String {
    const CELLS: usize = 60;
    let label = names.iter().map(|name| name.chars().count()).max().unwrap_or(0);
    let cells = CELLS.min(columns.saturating_sub(label + 3)).clamp(10, person.len().max(10));
    let robot_at = |second: usize| stays.iter().rev().find(|stay| stay.from_s <= second).and_then(|stay| stay.room);
    let mut text = String::new();
    for (room, name) in names.iter().enumerate() {
        let cell = |cell: usize| {
            let seconds = cell * person.len() / cells..(cell + 1) * person.len() / cells;
            let is_here = |second: usize| (person[second] == room, robot_at(second) == Some(room));
            let (mut of_person, mut of_robot, mut both) = (0, 0, false);
            for (is_person, is_robot) in seconds.clone().map(is_here) {
                of_person += usize::from(is_person);
                of_robot += usize::from(is_robot);
                both |= is_person && is_robot;
            }
            match () {
                () if both => '█',
                () if of_person.max(of_robot) == 0 => '·',
                () if of_person >= of_robot => '▄',
                () => '▀',
            }
        };
        let padding = " ".repeat(label - name.chars().count());
        text += &format!("{name}{padding}  {}\n", (0..cells).map(cell).collect::<String>());
    }
    let end = format!("{} s", person.len());
    let axis = format!("0 s{end:>width$}", width = cells.saturating_sub(3));
    text + &format!("{:label$}  {axis}\n{:label$}  ▄ {NAME}   ▀ robot   █ both in the room", "", "")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_story_is_in_the_third_person_and_in_good_english() {
        for (narrated, expected) in [
            ("They drink the mug.", "Ada drinks from the mug."),
            ("They drink the milk.", "Ada drinks the milk."),
            ("They walk to the coffee maker.", "Ada walks to the coffee maker."),
            ("They put the mug on the dishwasher.", "Ada puts the mug into the dishwasher."),
            ("They put the mug on the table.", "Ada puts the mug on the table."),
            ("They stand up.", "Ada stands up."),
            ("They sleep.", "Ada sleeps."),
            ("The door opens.", "The door opens."),
        ] {
            assert_eq!(told(narrated), expected);
        }
        let reason = "Waiting: Ada is in the hall. waits in a room that is done; plan: 1 room left";
        assert_eq!(sentences(reason), "Waiting: Ada is in the hall. Waits in a room that is done; plan: 1 room left.");
    }

    #[test]
    fn the_chart_shows_both_where_robot_and_person_share_a_room() {
        let names = ["kitchen".to_owned(), "hall".to_owned()];
        let person: Vec<usize> = (0..20).map(|second| usize::from(second >= 10)).collect();
        let stay = |from_s, room| Stay { from_s, room: Some(room), works: true };
        let shown = chart(&names, &person, &[stay(0, 1), stay(8, 0)], 20);
        let rows: Vec<&str> = shown.lines().collect();
        assert_eq!(rows[0], "kitchen  ▄▄▄▄█▀▀▀▀▀");
        assert_eq!(rows[1], "hall     ▀▀▀▀·▄▄▄▄▄");
        assert_eq!(rows[2], "         0 s   20 s");
    }
}
