//! The words of the messages' flags.

use roomcast_ipc::raw::{decision_flags, forecast_flags, score_flags};

fn set(flags: u32, names: &[(u32, &'static str)]) -> Vec<&'static str> {
    names.iter().filter(|(flag, _)| flags & flag != 0).map(|(_, name)| *name).collect()
}

#[must_use]
pub fn score_flag_names(flags: u32) -> Vec<&'static str> {
    set(
        flags,
        &[
            (score_flags::HEARTBEAT, "heartbeat"),
            (score_flags::NO_NARRATION, "no-narration"),
            (score_flags::BEHIND, "behind"),
            (score_flags::GAP, "gap"),
            (score_flags::SOURCES_CUT, "sources-cut"),
            (score_flags::SCORER_FAILED, "scorer-failed"),
            (score_flags::NOBODY_HOME, "nobody-home"),
            (score_flags::PREPARED, "prepared"),
            (score_flags::UNFAMILIAR, "unfamiliar"),
            (score_flags::MODEL_WEAK, "model-weak"),
        ],
    )
}

#[must_use]
pub fn forecast_flag_names(flags: u32) -> Vec<&'static str> {
    set(
        flags,
        &[
            (forecast_flags::NOT_KNOWN, "not-known"),
            (forecast_flags::RESTORED, "restored"),
            (forecast_flags::NOBODY_HOME, "nobody-home"),
            (forecast_flags::RESIDENT_UNKNOWN, "resident-unknown"),
            (forecast_flags::UNFAMILIAR, "unfamiliar"),
            (forecast_flags::MODEL_WEAK, "model-weak"),
        ],
    )
}

#[must_use]
pub fn decision_flag_names(flags: u32) -> Vec<&'static str> {
    set(
        flags,
        &[
            (decision_flags::FALLBACK, "fallback"),
            (decision_flags::STALE, "stale"),
            (decision_flags::NO_SCORES, "no-scores"),
            (decision_flags::DAEMON_SILENT, "daemon-silent"),
            (decision_flags::COVERED, "covered"),
            (decision_flags::INTERRUPTED, "interrupted"),
            (decision_flags::REPORTED, "reported"),
            (decision_flags::DEADLINE, "deadline"),
            (decision_flags::NOT_KNOWN, "not-known"),
            (decision_flags::NOBODY_HOME, "nobody-home"),
            (decision_flags::ROBOT_SILENT, "robot-silent"),
            (decision_flags::OWED, "owed"),
            (decision_flags::ELSEWHERE, "elsewhere"),
            (decision_flags::HELD, "held"),
        ],
    )
}

/// A flag in words for people. JSON has the flag itself.
#[must_use]
pub fn plain(flag: &str) -> &str {
    match flag {
        "asleep" => "probably asleep",
        "behind" => "scores lag behind the narration",
        "by-fit" => "person guessed by place and time",
        "covered" => "all rooms done",
        "daemon-silent" => "the daemon is silent",
        "deadline" => "last chance before the deadline",
        "elsewhere" => "decided in another domain",
        "fallback" => "safe choice instead of the policy's",
        "gap" => "narration was lost",
        "held" => "held by a person",
        "interrupted" => "a person came in",
        "model-weak" => "the model's scores are noise",
        "no-narration" => "no narration yet",
        "no-scores" => "no scores yet",
        "nobody-home" => "all persons are away",
        "not-known" => "places of persons unknown",
        "owed" => "the robot owes a report",
        "prepared" => "computed in advance",
        "reported" => "done rooms as the robot reports",
        "resident-unknown" => "a resident's place is unknown",
        "restored" => "not observed since the start",
        "robot-silent" => "the robot is silent",
        "scorer-failed" => "scoring failed",
        "sources-cut" => "more narrators than the list holds",
        "stale" => "old scores",
        "unfamiliar" => "the model does not know these words",
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use roomcast_services::daemon::flag_words;

    use super::*;

    #[test]
    fn flags_have_names() {
        assert_eq!(score_flag_names(score_flags::GAP | score_flags::NOBODY_HOME), ["gap", "nobody-home"]);
        assert_eq!(forecast_flag_names(u32::MAX).len(), 6);
        assert_eq!(decision_flag_names(u32::MAX).len(), 14);
    }

    #[test]
    fn every_flag_has_words_for_people() {
        let persons = flag_words(u32::MAX).collect();
        let all = [
            score_flag_names(!score_flags::HEARTBEAT),
            forecast_flag_names(u32::MAX),
            decision_flag_names(u32::MAX),
            persons,
        ];
        for flag in all.into_iter().flatten().filter(|flag| *flag != "visitor") {
            assert!(plain(flag) != flag && !plain(flag).contains('-'), "{flag}");
        }
    }

    /// Readers of JSON find every flag's meaning there.
    #[test]
    fn the_manual_has_every_flag() {
        let manual = include_str!("../docs/json.md");
        let persons = flag_words(u32::MAX).collect();
        let all = [score_flag_names(u32::MAX), forecast_flag_names(u32::MAX), persons];
        for flag in all.iter().flatten() {
            assert!(manual.contains(&format!("`{flag}`")), "docs/json.md does not have {flag}");
        }
    }
}
