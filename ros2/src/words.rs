//! Narration, decisions and reports as sentences, for `std_msgs/String`.

use roomcast_ipc::raw::{DecisionV1, RobotReportV1, action, report_kind};

use crate::types::Text;

/// The sentence of an event, preceded by the person's name unless it begins with it.
#[must_use]
pub fn narration(said: &str, name: Option<&str>) -> Text {
    let data = match name {
        Some(name) if !name.is_empty() && !said.starts_with(name) => format!("{name}: {said}"),
        _ => said.to_owned(),
    };
    Text { data }
}

/// A robot's decision and the reason.
#[must_use]
pub fn decision(decision: &DecisionV1, robot: &str) -> Text {
    let (from, to) = (decision.from(), decision.to());
    let mut data = match decision.action {
        action::GO if from.is_empty() || from == to => format!("{robot} goes to {to}"),
        action::GO => format!("{robot} goes from {from} to {to}"),
        action::PAUSE => format!("{robot} pauses where it disturbs nobody"),
        _ if !to.is_empty() && to != from => format!("{robot} waits in {to}, where nothing is to be done"),
        _ => format!("{robot} stays where it is"),
    };
    add(&mut data, ": ", decision.reason());
    if decision.cancels > 0 {
        data += &format!("; decision {} does not hold any more", decision.cancels);
    }
    Text { data }
}

/// A robot's report.
#[must_use]
pub fn report(report: &RobotReportV1, robot: &str) -> Text {
    let what = match report.kind {
        report_kind::POSITION => "says where it is",
        report_kind::STARTED => "has begun to work",
        report_kind::FINISHED => "has finished its work",
        report_kind::FAILED => "has failed",
        report_kind::BLOCKED => "does not get in",
        report_kind::DOCKED => "is at its dock",
        report_kind::BATTERY => "says how full its battery is",
        report_kind::CANCELLED => "does not follow a decision any more",
        report_kind::HOLD => "is held by a person",
        report_kind::RESUME => "is held no longer",
        report_kind::CLEAN => "is asked by a person to clean a room",
        report_kind::SKIP => "is asked by a person to skip a room today",
        _ => "says something that is not known here",
    };
    let mut data = format!("{robot} {what}");
    add(&mut data, " in ", report.room());
    if report.decision_sequence > 0 {
        data += &format!(", for decision {}", report.decision_sequence);
    }
    if let Some([x, y, z]) = report.position_m() {
        data += &format!(", at {x:.2}, {y:.2}, {z:.2} m");
    }
    if let Some(battery) = report.battery() {
        data += &format!(", battery at {:.0} %", battery * 100.0);
    }
    add(&mut data, ": ", report.note());
    Text { data }
}

fn add(data: &mut String, between: &str, words: &str) {
    if !words.is_empty() {
        data.push_str(between);
        data.push_str(words);
    }
}

#[cfg(test)]
mod tests {
    use roomcast_ipc::raw::report_flags;
    use roomcast_ipc::text;

    use super::*;

    #[test]
    fn a_sentence_has_the_name_of_its_person_once() {
        let said = |sentence: &str, name| narration(sentence, name).data;
        assert_eq!(said("They sit.", Some("Ada")), "Ada: They sit.");
        assert_eq!(said("Ada sits.", Some("Ada")), "Ada sits.");
        assert_eq!((said("They sit.", None), said("They sit.", Some(""))), ("They sit.".into(), "They sit.".into()));
    }

    #[test]
    fn a_decision_says_who_goes_where_and_why() {
        let room = |name: &str| text::encode("room", name).unwrap();
        let told = DecisionV1 {
            action: action::GO,
            from: room("kitchen"),
            to: room("bathroom"),
            reason: text::encode("reason", "nobody is likely there").unwrap(),
            ..Default::default()
        };
        let said = |told: &DecisionV1| decision(told, "robot").data;
        assert_eq!(said(&told), "robot goes from kitchen to bathroom: nobody is likely there");
        assert_eq!(
            said(&DecisionV1 { from: room(""), cancels: 3, ..told }),
            "robot goes to bathroom: nobody is likely there; decision 3 does not hold any more"
        );
        let waits = DecisionV1 { action: action::STAY, ..told };
        assert!(said(&waits).starts_with("robot waits in bathroom, where nothing is to be done: "));
        assert!(said(&DecisionV1 { to: room("kitchen"), ..waits }).starts_with("robot stays where it is: "));
        let pauses = DecisionV1 { action: action::PAUSE, reason: [0; 256], ..told };
        assert_eq!(said(&pauses), "robot pauses where it disturbs nobody");
    }

    #[test]
    fn a_report_says_all_that_is_in_it() {
        let told = RobotReportV1 {
            kind: report_kind::FAILED,
            decision_sequence: 4,
            room: text::encode("room", "kitchen").unwrap(),
            note: text::encode("note", "brush jammed").unwrap(),
            position_m: [1.0, 2.0, 0.0],
            battery: 0.5,
            flags: report_flags::HAS_POSITION | report_flags::HAS_BATTERY,
            ..Default::default()
        };
        assert_eq!(
            report(&told, "robot").data,
            "robot has failed in kitchen, for decision 4, at 1.00, 2.00, 0.00 m, battery at 50 %: brush jammed"
        );
        assert_eq!(
            report(&RobotReportV1 { kind: report_kind::DOCKED, ..Default::default() }, "robot").data,
            "robot is at its dock"
        );
    }
}
