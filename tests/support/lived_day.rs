//! A day of a person in a flat of four rooms, with a robot that cleans it; for tests of the robot's driver with and without processes.

/// The person's place from each hour on: the index of a room in [`segments`], or away.
const DAY: [(f64, Option<usize>); 16] = [
    (0.0, Some(0)),
    (7.0, Some(2)),
    (7.6, Some(1)),
    (7.7, Some(3)),
    (9.5, Some(2)),
    (9.8, Some(3)),
    (12.0, Some(2)),
    (13.0, None),
    (14.0, Some(3)),
    (16.0, Some(2)),
    (16.3, Some(3)),
    (18.0, Some(2)),
    (19.5, Some(3)),
    (21.0, Some(1)),
    (21.1, Some(0)),
    (24.0, None),
];
/// Seconds for a room.
pub(crate) const ROOM_S: f64 = 1500.0;
/// The robot works from 8 to 20.
pub(crate) const HOURS: (u64, u64) = (8, 20);

/// The robot's rooms: number, name, seconds.
pub(crate) fn segments(seconds: f64) -> [(&'static str, &'static str, f64); 4] {
    [("1", "Schlafzimmer", seconds), ("2", "Flur", seconds), ("3", "Küche", seconds), ("4", "Büro", seconds)]
}

pub(crate) fn person_at(hour: f64) -> Option<usize> {
    DAY.iter().rev().find(|(from, _)| hour >= *from).and_then(|(_, room)| *room)
}

/// Minutes shared with the person by a robot that starts at this hour and cleans room after room.
fn plain_schedule(hour: f64) -> f64 {
    let seconds = 0..(segments(ROOM_S).len() as f64 * ROOM_S) as u64;
    let together = |s: &u64| person_at(hour + *s as f64 / 3600.0) == Some((*s as f64 / ROOM_S) as usize);
    seconds.filter(together).count() as f64 / 60.0
}

/// Shared minutes of plain schedules by start hour: schedules that end within the robot's hours.
pub(crate) fn plain_schedules() -> Vec<f64> {
    (HOURS.0..HOURS.1 - 2).map(|hour| plain_schedule(hour as f64)).collect()
}

pub(crate) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}
