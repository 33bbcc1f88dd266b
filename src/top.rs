//! State and drawing of `roomcast top`, without ports, clock or terminal: a test feeds it messages and reads the text.

use std::collections::{BTreeMap, VecDeque};

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Style, Stylize};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Paragraph};
use roomcast_core::ids::{BootNs, PersonId};
use roomcast_ipc::raw::{
    DecisionV1, NarrationV1, PersonForecastV1, PersonForecastsV1, PersonScoresV1, RobotReportV1, RoomScoresV1,
    StatusResponseV1, forecast_flags, presence, reached, score_flags,
};
use roomcast_ipc::{ItemScores, Presence, sequence};

use crate::bar::bar;
use crate::columns::wrapped;
use crate::flags::{decision_flag_names, forecast_flag_names, plain, score_flag_names};
use crate::robot_place::Places;
use roomcast_services::daemon::flag_words;
use roomcast_services::habits_reason::ELSEWHERE;
use roomcast_services::message_text::event_of;

/// Points of a room's line that are kept; the widest terminal shows them all.
const HISTORY_POINTS: usize = 512;
const NARRATIONS: usize = 256;
/// Time from one point of a room's line to the next, in nanoseconds.
pub const POINT_NS: u64 = 500_000_000;
/// Silence after which the daemon counts as gone, in nanoseconds: some heartbeats.
const SILENCE_NS: u64 = 1_500_000_000;
/// A person's line uses the first horizon of at least this many seconds.
const AHEAD_S: f32 = 3600.0;
/// A person's set of places uses the first horizon of at least this many seconds, and the learned share at this index is nearest to it.
const SET_S: f32 = 900.0;
const SET_SHARE: usize = 1;

const HEADING: &str = "rooms: where somebody is next, and its course";
/// With fewer rows for rooms and persons, their panel has no frame.
const FRAMED_ROWS: usize = 14;

/// The width of the last column: the time since a room was cleaned.
const CLEANED_WIDTH: usize = 13;

#[must_use]
pub fn ago(minutes: u16) -> String {
    match minutes {
        0..120 => format!("done {minutes} min"),
        120..2880 => format!("done {} h", minutes / 60),
        _ => format!("done {} d", minutes / 1440),
    }
}

/// A person's name, else the number.
#[must_use]
pub fn who(person: PersonId, name: &str) -> String {
    if name.is_empty() { format!("person {person}") } else { name.to_owned() }
}

/// A room's scores over time, one point per [`POINT_NS`].
#[derive(Debug, Clone, Default)]
struct Room {
    id: String,
    probability: f64,
    points: VecDeque<f64>,
}

#[derive(Debug, Default)]
pub struct View {
    scores: Option<RoomScoresV1>,
    rooms: Vec<Room>,
    /// The lines of persons, if they add to the rooms' lines.
    persons: Vec<String>,
    /// By person: the observation with the largest effect on the belief.
    reasons: BTreeMap<u32, String>,
    forecasts: Option<Box<PersonForecastsV1>>,
    forecast_flags: u32,
    narration: VecDeque<(String, String)>,
    labels: Vec<(String, f64)>,
    decision: Option<DecisionV1>,
    places: Places,
    /// The configured robot's number. Others are shown only before its first decision.
    robot: u64,
    status: Option<StatusResponseV1>,
    snapshots_missed: u64,
    malformed: u64,
    /// While set, messages are ignored.
    pub paused: bool,
    /// While set, the keys are explained.
    pub help: bool,
}

impl View {
    /// A view for the configured robot.
    #[must_use]
    pub fn of_robot(robot: &str) -> Self {
        Self { robot: sequence::source_of_name(robot), ..Self::default() }
    }

    /// Handles room scores. A jump in their sequence counts overwritten snapshots.
    pub fn scores(&mut self, scores: &RoomScoresV1) {
        if let Some(last) = &self.scores
            && last.epoch == scores.epoch
            && scores.sequence > last.sequence
        {
            self.snapshots_missed = self.snapshots_missed.saturating_add(scores.sequence - last.sequence - 1);
        }
        let same_map = self.rooms.len() == scores.rooms().len()
            && self.rooms.iter().zip(scores.rooms()).all(|(own, new)| own.id == new.id());
        if !same_map {
            self.rooms =
                scores.rooms().iter().map(|room| Room { id: room.id().to_owned(), ..Room::default() }).collect();
        }
        for (own, new) in self.rooms.iter_mut().zip(scores.rooms()) {
            own.probability = new.probability;
        }
        self.scores = Some(*scores);
    }

    pub fn narration(&mut self, narration: &NarrationV1) {
        if self.narration.len() == NARRATIONS {
            self.narration.pop_front();
        }
        // As the model reads it, or the raw text if it is not an observation.
        let said = event_of(narration.kind, narration.text());
        let text = said.map_or_else(|_| narration.text().to_owned(), |said| said.to_string());
        let source = match narration.person_name() {
            "" => narration.source_name().to_owned(),
            name => format!("{name} (told by {})", narration.source_name()),
        };
        self.narration.push_back((source, text));
    }

    /// Handles item scores: shows the labels with the highest sums over their items.
    pub fn items(&mut self, items: &ItemScores) {
        let mut labels: Vec<(String, f64)> = Vec::new();
        for item in &items.items {
            let score = item.log_score_nats.exp();
            match labels.iter_mut().find(|(label, _)| label == item.label()) {
                Some((_, sum)) => *sum += score,
                None => labels.push((item.label().to_owned(), score)),
            }
        }
        labels.sort_by(|a, b| b.1.total_cmp(&a.1));
        self.labels = labels;
    }

    /// Handles persons' scores: presence, the place now, and the likeliest next room. A single person at home without a name needs no line: the rooms
    /// show it.
    pub fn persons(&mut self, scores: &PersonScoresV1) {
        self.persons.clear();
        let plain = |persons: &[roomcast_ipc::raw::PersonV1]| {
            persons.iter().all(|person| person.name().is_empty() && person.presence <= presence::PRESENT)
        };
        let forecasts = self.forecasts.as_deref().filter(|forecasts| forecasts.epoch == scores.epoch);
        let learned = forecasts.is_some_and(|told| told.persons().iter().any(|own| own.set_coverage > 0.0));
        if scores.persons().len() < 2 && plain(scores.persons()) && !learned {
            return;
        }
        for person in scores.persons() {
            let own = forecasts.and_then(|told| told.persons().iter().find(|own| own.person == person.person));
            let mut line =
                format!("{}: {}", who(PersonId(person.person), person.name()), Presence::of(person.presence));
            if let (Some(told), Some(own)) = (forecasts, own) {
                line.push_str(&forecast_words(told, own));
            }
            let likeliest = scores.probabilities(person).max_by(|a, b| a.1.total_cmp(&b.1));
            if let Some((room, probability)) = likeliest.filter(|_| person.presence <= presence::PRESENT) {
                line.push_str(&format!(", next {room} {:.1} %", 100.0 * probability));
            }
            for word in flag_words(person.flags) {
                line.push_str(", ");
                line.push_str(crate::flags::plain(word));
            }
            self.persons.push(line);
            self.persons.extend(self.reasons.get(&person.person).map(|reason| format!("  {reason}")));
            // Before anything was learned, habits have a share in the forecast too, but it says nothing about this person.
            let has_learned = self.status.as_ref().is_none_or(|status| status.learned > 0);
            self.persons.extend(forecasts.zip(own).and_then(|(told, own)| set_words(told, own, has_learned)));
        }
        let left_out = (scores.persons as usize).saturating_sub(scores.persons().len());
        if left_out > 0 {
            self.persons.push(format!("and {left_out} more"));
        }
    }

    /// Handles reasons for beliefs, which are shown with the next scores.
    pub fn reasons(&mut self, reasons: &BTreeMap<u32, String>) {
        self.reasons.clone_from(reasons);
    }

    /// Handles persons' forecasts, which are shown with the next scores.
    pub fn forecasts(&mut self, forecasts: &PersonForecastsV1) {
        self.forecasts = Some(Box::new(*forecasts));
    }

    /// Handles the flags of the forecast of all persons: bits of [`roomcast_ipc::raw::forecast_flags`].
    pub fn forecast_flags(&mut self, flags: u32) {
        self.forecast_flags = flags;
    }

    pub fn decision(&mut self, decision: &DecisionV1) {
        if decision.robot == self.robot || self.decision.is_none_or(|known| known.robot != self.robot) {
            self.decision = Some(*decision);
        }
    }

    pub fn report(&mut self, report: &RobotReportV1) {
        self.places.take(report, self.decision.as_ref());
    }

    /// Handles the daemon's status; the last one stays, with its age.
    pub fn status(&mut self, status: StatusResponseV1) {
        self.status = Some(status);
    }

    pub fn malformed(&mut self, messages: u64) {
        self.malformed = messages;
    }

    /// Adds a point to every room's line. The caller does this every [`POINT_NS`].
    pub fn point(&mut self) {
        for room in &mut self.rooms {
            if room.points.len() == HISTORY_POINTS {
                room.points.pop_front();
            }
            room.points.push_back(room.probability);
        }
    }

    /// Draws everything; `now_ns` is by the monotonic clock.
    pub fn draw(&self, frame: &mut Frame<'_>, now_ns: BootNs) {
        let area = frame.area();
        let persons = self.person_lines(area.width);
        let room_rows = ((self.rooms.len().max(1) + persons.len()) as u16).saturating_add(2);
        let [head, rooms, lower, decision, health, keys] =
            Layout::vertical(heights(area.height, room_rows).map(Constraint::Length)).areas(area);
        frame.render_widget(self.head(now_ns), head);
        self.draw_rooms(frame, rooms, &persons);
        let [narration, labels] =
            Layout::horizontal([Constraint::Percentage(60), Constraint::Percentage(40)]).areas(lower);
        self.draw_narration(frame, narration);
        self.draw_labels(frame, labels);
        frame.render_widget(Paragraph::new(self.decision_lines(now_ns)).block(titled("robot")), decision);
        frame.render_widget(Paragraph::new(self.health_lines(now_ns)).block(titled("health")), health);
        let pause = if self.paused { "space goes on" } else { "space pauses" };
        frame.render_widget(Line::from(format!(" q quits   {pause}   h explains")).dim(), keys);
        if self.help {
            draw_help(frame, area);
        }
    }

    fn head(&self, now_ns: BootNs) -> Line<'static> {
        let title = Span::from(" roomcast ").bold().reversed();
        let Some(scores) = &self.scores else {
            return Line::from(vec![title, Span::from("  no daemon has been heard yet").yellow()]);
        };
        let silence_ns = scores.silence_ns(now_ns.0);
        let alive = if silence_ns > SILENCE_NS {
            Span::from(format!("  daemon silent for {:.1} s", silence_ns as f64 / 1e9)).red().bold()
        } else {
            Span::from("  daemon alive").green()
        };
        let known = self
            .status
            .as_ref()
            .map_or(String::new(), |status| format!("  {} on {}", decoded(&status.model), decoded(&status.map)));
        let paused = if self.paused { "  PAUSED" } else { "" };
        Line::from(vec![title, alive, Span::from(known), Span::from(paused).yellow()])
    }

    /// The persons' lines, wrapped for a framed panel of this width.
    fn person_lines(&self, width: u16) -> Vec<String> {
        const INDENT: usize = 4;
        let columns = usize::from(width.saturating_sub(2));
        let indent = if columns > 2 * INDENT { INDENT } else { 0 };
        let lines = self.persons.iter().map(|line| wrapped(line, columns, indent));
        lines.flat_map(|lines| lines.lines().map(str::to_owned).collect::<Vec<_>>()).collect()
    }

    fn draw_rooms(&self, frame: &mut Frame<'_>, area: Rect, persons: &[String]) {
        let name_width = self.rooms.iter().map(|room| room.id.chars().count()).max().unwrap_or(4).min(24);
        // On a small screen, content comes before the frame.
        let is_framed = area.height >= 2 + (self.rooms.len() + persons.len()).min(FRAMED_ROWS) as u16;
        let frame_size = if is_framed { 2 } else { 0 };
        let inner = usize::from(area.width.saturating_sub(frame_size));
        // Name and percentage have fixed widths; bar and line share the rest.
        let is_cleaned = self.decision.is_some_and(|decision| decision.cleaned_min.iter().any(|minutes| *minutes > 0));
        let rest = inner.saturating_sub(name_width + 9 + if is_cleaned { CLEANED_WIDTH } else { 0 });
        let bar_width = rest * 2 / 5;
        let line_width = rest.saturating_sub(bar_width + 1);
        let most = self.rooms.iter().map(|room| room.probability).fold(0.0, f64::max);
        let lines = self.rooms.iter().enumerate().map(|(place, room)| {
            let cleaned = self.decision.filter(|_| is_cleaned).map_or_else(String::new, |decision| {
                let ago = decision.cleaned_min.get(place).copied().unwrap_or_default().checked_sub(1).map(ago);
                format!("{:>CLEANED_WIDTH$}", ago.unwrap_or_default())
            });
            let color = if room.probability >= most { Color::Yellow } else { Color::Cyan };
            Line::from(vec![
                Span::from(format!("{:<name_width$} ", cut(&room.id, name_width))),
                Span::from(format!("{:5.1} % ", 100.0 * room.probability)).bold(),
                Span::styled(format!("{:<bar_width$} ", bar(room.probability, bar_width)), Style::new().fg(color)),
                Span::styled(
                    format!("{:<line_width$}", sparkline(&room.points, line_width)),
                    Style::new().fg(color).dim(),
                ),
                Span::from(cleaned).dim(),
            ])
        });
        let mut lines: Vec<_> = lines.chain(persons.iter().map(|line| Line::from(line.as_str()))).collect();
        // Lines that do not fit are counted.
        let rows = usize::from(area.height.saturating_sub(frame_size));
        if lines.len() > rows && rows > 0 {
            let hidden = lines.len() - (rows - 1);
            lines.truncate(rows - 1);
            lines.push(Line::from(format!("and {hidden} more lines: a taller terminal has room for them")).dim());
        }
        let text = Paragraph::new(lines);
        frame.render_widget(if is_framed { text.block(titled(HEADING)) } else { text }, area);
    }

    fn draw_narration(&self, frame: &mut Frame<'_>, area: Rect) {
        let rows = usize::from(area.height.saturating_sub(2));
        let from = self.narration.len().saturating_sub(rows);
        let lines: Vec<_> = (self.narration.iter().skip(from))
            .map(|(source, text)| Line::from(vec![Span::from(format!("{source}: ")).dim(), Span::from(text.clone())]))
            .collect();
        let nothing = || vec![Line::from("nothing since this began").dim()];
        let lines = if lines.is_empty() { nothing() } else { lines };
        frame.render_widget(Paragraph::new(lines).block(titled("narration")), area);
    }

    fn draw_labels(&self, frame: &mut Frame<'_>, area: Rect) {
        let rows = usize::from(area.height.saturating_sub(2));
        let width = usize::from(area.width.saturating_sub(11));
        let lines: Vec<_> = (self.labels.iter().take(rows))
            .map(|(label, share)| Line::from(format!("{:<width$} {:5.1} %", cut(label, width), 100.0 * share)))
            .collect();
        frame.render_widget(Paragraph::new(lines).block(titled("what comes next")), area);
    }

    fn decision_lines(&self, now_ns: BootNs) -> Vec<Line<'static>> {
        let Some(decision) = &self.decision else { return vec![Line::from("no decision has been heard yet").dim()] };
        let age_s = now_ns.since(BootNs(decision.decided_ns)) as f64 / 1e9;
        let robot = match decision.robot_name() {
            name if decision.robot != self.robot && !name.is_empty() => format!("{name}: "),
            _ => String::new(),
        };
        let place = self.places.of(decision.robot).words(str::to_owned);
        let mut first = vec![
            Span::from(robot),
            Span::from(format!("{} ", decision.to())).bold(),
            Span::from(format!(
                "({:.1} % likely to be occupied), by {}, {age_s:.0} s ago",
                100.0 * decision.probability,
                decision.policy()
            )),
            Span::from(format!("  [{place}]")).cyan(),
        ];
        for name in decision_flag_names(decision.flags) {
            first.push(Span::from(format!("  {}", plain(name))).yellow());
        }
        vec![Line::from(first), Line::from(decision.reason().to_owned())]
    }

    fn health_lines(&self, now_ns: BootNs) -> Vec<Line<'static>> {
        let mut first = Vec::new();
        if let Some(scores) = &self.scores {
            let reached = match scores.reached {
                reached::EXACT => "exact",
                reached::RANKING => "ranking certain",
                reached::TOP => "top certain",
                _ => "order not certain",
            };
            let stages_ns = [scores.tokenise_ns, scores.prefix_ns, scores.trie_ns, scores.ground_ns];
            let step_ns = stages_ns.into_iter().fold(0, u64::saturating_add);
            first.push(Span::from(format!(
                "step {:.1} ms ({reached}), labels together {:.0} %",
                step_ns as f64 / 1e6,
                100.0 * scores.label_mass
            )));
            // A missing resident is not in any room's line.
            let of_forecast = forecast_flag_names(self.forecast_flags & forecast_flags::RESIDENT_UNKNOWN);
            for name in score_flag_names(scores.flags & !score_flags::HEARTBEAT).into_iter().chain(of_forecast) {
                first.push(Span::from(format!("  {}", plain(name))).yellow());
            }
        }
        let second = match &self.status {
            None => Line::from("the daemon has not answered for itself yet").dim(),
            Some(status) => {
                let age_s = now_ns.since(BootNs(status.answered_ns)) as f64 / 1e9;
                let age = if age_s > 3.0 { format!("{age_s:.0} s ago: ") } else { String::new() };
                let lost: Vec<String> = [
                    (status.missed, "missed"),
                    (status.malformed, "malformed"),
                    (status.ahead, "from a fast clock"),
                    (status.failed_steps, "failed steps"),
                    (status.journal_failures, "faults of the state database"),
                    (self.snapshots_missed, "snapshots missed here"),
                    (self.malformed, "malformed here"),
                ]
                .into_iter()
                .filter(|(count, _)| *count > 0)
                .map(|(count, what)| format!("{count} {what}"))
                .collect();
                // Losses come first: the line may be too long for the screen.
                let lost = if lost.is_empty() { "nothing lost".to_owned() } else { lost.join(", ") };
                let learned = match status.learned {
                    0 => String::new(),
                    learned => format!("; {learned} learned, {} KiB", status.habits_bytes >> 10),
                };
                Line::from(format!(
                    "{age}{} narrations, {lost}; event to scores {:.1} ms median, {:.1} ms p99{learned}",
                    status.accepted,
                    status.latency_p50_ns as f64 / 1e6,
                    status.latency_p99_ns as f64 / 1e6,
                ))
            }
        };
        vec![Line::from(first), second]
    }
}

/// Rows of the head, rooms, narration, robot, health and keys on a screen of `height` rows. Rooms and persons want `room_rows`.
///
/// Rooms get at least eight rows and at most half of the screen. Panels that do not fit are dropped, the robot's last. Narration gets the rest, or
/// else the rooms do.
fn heights(height: u16, room_rows: u16) -> [u16; 6] {
    const ROOMS_FIRST: u16 = 8;
    let keys = u16::from(height > ROOMS_FIRST + 1);
    let body = height.saturating_sub(1 + keys);
    let mut rooms = room_rows.min(ROOMS_FIRST.max(height / 2)).min(body);
    let mut left = body - rooms;
    let mut panel = |rows: u16| {
        let rows = if left >= rows { rows } else { 0 };
        left -= rows;
        rows
    };
    let (decision, mut lower, health) = (panel(4), panel(3), panel(4));
    *(if lower > 0 { &mut lower } else { &mut rooms }) += left;
    [1, rooms, lower, decision, health, keys]
}

/// A person's place now, and the probability of another place later.
fn forecast_words(told: &PersonForecastsV1, own: &PersonForecastV1) -> String {
    let now = told.rooms().zip(&own.probability).map(|(room, row)| (room, row[0]));
    let now = now.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|_| own.presence <= presence::PRESENT);
    let mut words = now.map_or_else(String::new, |(room, p)| format!(", now {room} {:.1} %", 100.0 * p));
    let ahead = told.horizons_s().iter().position(|horizon_s| *horizon_s >= AHEAD_S);
    if let Some((horizon, elsewhere)) =
        ahead.map(|horizon| (horizon, own.elsewhere[horizon])).filter(|ahead| ahead.1 > 0.0)
    {
        let minutes = told.horizons_s()[horizon] / 60.0;
        words.push_str(&format!(", elsewhere in {minutes:.0} min {:.1} %", 100.0 * elsewhere));
    }
    words
}

/// A person's later room set, its probability, and the habits' share of the forecast if any are learned. `None` without sets.
fn set_words(told: &PersonForecastsV1, own: &PersonForecastV1, has_learned: bool) -> Option<String> {
    let horizon = told.horizons_s().iter().position(|horizon_s| *horizon_s >= SET_S)?;
    let minutes = told.horizons_s()[horizon] / 60.0;
    let places = set_places(told, own, horizon)?.join(" or ");
    let learned = match has_learned {
        true => format!(", {:.0} % learned", 100.0 * own.learned_share[SET_SHARE]),
        false => String::new(),
    };
    let sure = 100.0 * own.set_probability(horizon)?;
    Some(format!("  in {minutes:.0} min: {places} ({sure:.0} % sure{learned})"))
}

/// The places of a horizon's set: ids of rooms, and elsewhere. `None` without sets.
pub fn set_places<'a>(told: &'a PersonForecastsV1, own: &PersonForecastV1, horizon: usize) -> Option<Vec<&'a str>> {
    let elsewhere = own.set_holds_elsewhere(horizon)?;
    let rooms = told.rooms().enumerate().filter(|(room, _)| own.set_holds(horizon, *room) == Some(true));
    Some(rooms.map(|(_, id)| id).chain(elsewhere.then_some(ELSEWHERE)).collect())
}

fn titled(title: &'static str) -> Block<'static> {
    Block::bordered().title(Span::from(format!(" {title} ")).dim()).border_style(Style::new().dim())
}

/// A name field of a status answer; "?" if it is no text.
fn decoded(bytes: &[u8]) -> String {
    roomcast_ipc::text::decode("name", bytes).unwrap_or("?").to_owned()
}

/// At most `width` characters of `text`, with an ellipsis if it was cut.
fn cut(text: &str, width: usize) -> String {
    if text.chars().count() <= width {
        return text.to_owned();
    }
    text.chars().take(width.saturating_sub(1)).chain(['…']).collect()
}

/// The newest `width` points as blocks, the newest at the right; 0 is the lowest block and 1 the full one.
fn sparkline(points: &VecDeque<f64>, width: usize) -> String {
    const LEVELS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
    let shown = points.iter().skip(points.len().saturating_sub(width));
    let line: String = shown.map(|&p| LEVELS[((p.clamp(0.0, 1.0) * 8.0) as usize).min(7)]).collect();
    format!("{line:>width$}")
}

fn draw_help(frame: &mut Frame<'_>, area: Rect) {
    let lines = [
        "rooms      the chance that a person's next action is there, and its course;",
        "           with several persons the rooms add up to more than 100 %;",
        "           one block is half a second, the newest at the right",
        "narration  what was observed, the newest at the bottom",
        "next       the likeliest objects; asking for them costs the daemon a little",
        "robot      the last decision of a planner, and its reason",
        "health     time of the last step, counters since the daemon's start",
        "",
        "q, Esc     quit          space  pause          h, ?  this",
    ];
    let width = area.width.min(78);
    let height = area.height.min(lines.len() as u16 + 2);
    let at = Rect { x: (area.width - width) / 2, y: (area.height - height) / 2, width, height };
    frame.render_widget(ratatui::widgets::Clear, at);
    frame.render_widget(Paragraph::new(lines.map(Line::from).to_vec()).block(titled("keys and panels")), at);
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;
    use roomcast_ipc::raw::{ItemScoreV1, ItemScoresHeaderV1, narration_kind, report_kind};
    use roomcast_ipc::text;

    fn scores(sequence: u64, probabilities: &[(&str, f64)]) -> RoomScoresV1 {
        let mut scores = RoomScoresV1 {
            epoch: 1,
            sequence,
            published_ns: 1_000_000_000,
            room_count: probabilities.len() as u32,
            label_mass: 0.87,
            prefix_ns: 4_200_000,
            ..Default::default()
        };
        for (room, &(id, probability)) in scores.room.iter_mut().zip(probabilities) {
            room.id = text::encode("id", id).unwrap();
            room.probability = probability;
        }
        scores
    }

    fn full() -> View {
        let mut view = View::default();
        for step in 0..30 {
            let kitchen = 0.1 + 0.8 * f64::from(step) / 29.0;
            view.scores(&scores(
                step as u64 + 1,
                &[("kitchen", kitchen), ("living-room", 0.9 - kitchen), ("bathroom", 0.1)],
            ));
            view.point();
        }
        for text in ["They walk to the kitchen.", "They open the fridge."] {
            let mut narration = NarrationV1::new(0, text).unwrap();
            narration.source_name = text::encode("name", "camera").unwrap();
            view.narration(&narration);
        }
        let item = |label: &str, probability: f64| ItemScoreV1 {
            id: text::encode("id", label).unwrap(),
            label: text::encode("label", label).unwrap(),
            log_score_nats: probability.ln(),
            partition: 0,
            label_items: 1,
        };
        view.items(&ItemScores {
            header: ItemScoresHeaderV1::default(),
            items: vec![item("milk", 0.2), item("fridge", 0.5), item("milk", 0.1)],
        });
        view.decision(&DecisionV1 {
            probability: 0.1,
            to: text::encode("to", "bathroom").unwrap(),
            policy: text::encode("policy", "informed-avoidance").unwrap(),
            reason: text::encode("reason", "the kitchen is the likeliest room").unwrap(),
            ..Default::default()
        });
        view.status(StatusResponseV1 { latency_p50_ns: 5_000_000, accepted: 30, ..Default::default() });
        view
    }

    fn drawn(view: &View, width: u16, height: u16, now_ns: BootNs) -> String {
        let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
        terminal.draw(|frame| view.draw(frame, now_ns)).unwrap();
        let buffer = terminal.backend().buffer();
        let row = |y| (0..width).map(|x| buffer[(x, y)].symbol()).collect::<String>();
        (0..height).map(|y| row(y).trim_end().to_owned() + "\n").collect()
    }

    #[test]
    fn of_several_robots_the_configured_one_is_shown_and_others_by_their_names() {
        let of = |robot: &str, to: &str| DecisionV1 {
            robot: sequence::source_of_name(robot),
            robot_name: text::encode_cut(robot),
            to: text::encode("to", to).unwrap(),
            ..Default::default()
        };
        let mut view = View::of_robot("dusty");
        view.decision(&of("rusty", "attic"));
        assert!(drawn(&view, 80, 24, BootNs(0)).contains("rusty: attic"));
        ["dusty", "rusty"].into_iter().zip(["cellar", "attic"]).for_each(|(robot, to)| view.decision(&of(robot, to)));
        let shown = drawn(&view, 80, 24, BootNs(0));
        assert!(shown.contains("cellar (") && !shown.contains("dusty:") && !shown.contains("attic"), "{shown}");
    }

    #[test]
    fn a_room_shows_when_it_was_cleaned_and_the_robot_shows_where_it_is() {
        let mut view = View::of_robot("robot");
        view.scores(&scores(1, &[("kitchen", 0.6), ("hall", 0.4)]));
        let mut decision = DecisionV1 { robot: sequence::source_of_name("robot"), ..Default::default() };
        decision.cleaned_min[1] = 181;
        view.decision(&decision);
        let shown = drawn(&view, 100, 24, BootNs(0));
        assert!(shown.contains("done 3 h") && shown.contains("[dry run]"), "{shown}");
        let docked = RobotReportV1 { robot: decision.robot, kind: report_kind::DOCKED, ..Default::default() };
        view.report(&docked);
        assert!(drawn(&view, 100, 24, BootNs(0)).contains("[on its dock]"));
        assert_eq!(
            [0, 119, 120, 2879, 2880].map(ago),
            ["done 0 min", "done 119 min", "done 2 h", "done 47 h", "done 2 d"]
        );
    }

    /// Numbers that pass the message's check, but that no daemon sends.
    #[test]
    fn extreme_numbers_are_drawn() {
        const MOST: u64 = u64::MAX;
        let mut view = full();
        let first = scores(1, &[("kitchen", 1.0)]);
        for epoch in 1..4 {
            view.scores(&RoomScoresV1 { epoch, ..first });
            let times = RoomScoresV1 { computed_ns: MOST, published_ns: MOST, observed_ns: MOST, ..first };
            let last = RoomScoresV1 { tokenise_ns: MOST, prefix_ns: MOST, trie_ns: MOST, ground_ns: MOST, ..times };
            view.scores(&RoomScoresV1 { epoch, sequence: MOST, wait_ns: MOST, received_ns: MOST, ..last });
        }
        assert_eq!(view.snapshots_missed, MOST);
        view.decision(&DecisionV1 {
            decided_ns: MOST,
            sequence: MOST,
            stay_ns: MOST,
            flags: u32::MAX,
            ..Default::default()
        });
        view.status(StatusResponseV1 {
            answered_ns: MOST,
            accepted: MOST,
            missed: MOST,
            malformed: MOST,
            ahead: MOST,
            failed_steps: MOST,
            learned: MOST,
            habits_bytes: MOST,
            latency_p50_ns: MOST,
            latency_p99_ns: MOST,
            ..Default::default()
        });
        let mut persons =
            PersonScoresV1 { epoch: 3, room_count: 1, persons: u32::MAX, person_count: 8, ..Default::default() };
        persons.id[0] = text::encode("id", "kitchen").unwrap();
        for person in &mut persons.person {
            (person.person, person.flags, person.since_ns, person.presence) = (u32::MAX, u32::MAX, MOST, 1);
        }
        let mut forecasts =
            PersonForecastsV1 { epoch: 3, person_count: 8, room_count: 1, horizon_count: 2, ..Default::default() };
        forecasts.horizon_s[..2].copy_from_slice(&[f32::MIN_POSITIVE, f32::MAX]);
        for person in &mut forecasts.person {
            (person.person, person.set_coverage, person.presence) = (u32::MAX, 1.0, 1);
            person.room_set = [MOST; 16];
        }
        view.forecasts(&forecasts);
        view.persons(&persons);
        view.forecast_flags(u32::MAX);
        for now_ns in [0, 1, MOST] {
            for (width, height) in [(1, 1), (80, 24), (200, 50)] {
                drawn(&view, width, height, BootNs(now_ns));
            }
        }
    }

    #[test]
    fn everything_fits_a_small_and_a_large_terminal() {
        for (width, height) in [(80, 24), (200, 50)] {
            let text = drawn(&full(), width, height, BootNs(1_100_000_000));
            println!("{text}");
            for part in [
                "daemon alive",
                "kitchen",
                "90.0 %",
                "living-room",
                "bathroom",
                "camera: They open the fridge.",
                "fridge",
                "50.0 %",
                "milk",
                "30.0 %",
                "informed-avoidance",
                "the kitchen is the likeliest room",
                "step 4.2 ms (exact)",
                "q quits",
            ] {
                assert!(text.contains(part), "{width} x {height} lacks {part:?}:\n{text}");
            }
        }
    }

    /// On the smallest screens the rooms stay, and the panels have exactly the available rows.
    #[test]
    fn a_tiny_terminal_shows_the_rooms() {
        let text = drawn(&full(), 40, 10, BootNs(1_100_000_000));
        for part in ["kitchen", "living-room", "bathroom", "90.0 %", "q quits"] {
            assert!(text.contains(part), "{part:?} is missing:\n{text}");
        }
        for height in 1..100 {
            for room_rows in 3..70 {
                let rows = heights(height, room_rows);
                assert_eq!(rows.iter().sum::<u16>(), height, "{rows:?}");
                assert!(
                    rows[1] >= room_rows.min(8).min(height.saturating_sub(2)),
                    "{rows:?} of {height}, {room_rows} wanted"
                );
            }
        }
    }

    #[test]
    fn a_tiny_terminal_shows_the_persons_too() {
        let mut view = full();
        let names = ["kitchen", "living-room", "bathroom", "bedroom", "office", "hall"];
        view.scores(&scores(31, &names.map(|name| (name, 1.0 / 6.0))));
        view.persons = vec!["ada: present".to_owned(), "ben: away".to_owned()];
        let text = drawn(&view, 40, 10, BootNs(1_100_000_000));
        for part in names.into_iter().chain(["ada: present", "ben: away", "q quits"]) {
            assert!(text.contains(part), "{part:?} is missing:\n{text}");
        }
        assert!(!text.contains("more lines"), "{text}");
    }

    #[test]
    fn persons_who_do_not_fit_are_counted() {
        let mut view = full();
        view.persons = (0..8).map(|number| format!("person {number}: present")).collect();
        let text = drawn(&view, 80, 10, BootNs(1_100_000_000));
        assert!(text.contains("person 1: present") && text.contains("more lines"), "{text}");
        let shown = (0..8).filter(|number| text.contains(&format!("person {number}"))).count();
        assert!(text.contains(&format!("and {} more lines", 8 - shown)), "{text}");
        assert!(!drawn(&view, 80, 40, BootNs(1_100_000_000)).contains("more lines"));
    }

    /// The kind decides how a text is read, as in the daemon.
    #[test]
    fn narration_is_shown_as_the_model_reads_it() {
        for (kind, text) in [
            (narration_kind::ACTION, "[Grab] <mug> (1)"),
            (narration_kind::ACTION, "[SwitchOn] <coffee_maker> (1)"),
            (narration_kind::DEVICE, "the oven is on"),
            (narration_kind::DEVICE, "oven on"),
            (narration_kind::SENTENCE, "[Grab] <mug> (1)"),
            (narration_kind::SENTENCE, "the oven is on"),
            (narration_kind::SENTENCE, "They leave the house."),
            (narration_kind::PRESENCE, "present in the kitchen"),
        ] {
            let mut view = View::default();
            view.narration(&NarrationV1::new(kind, text).unwrap());
            assert_eq!(view.narration[0].1, event_of(kind, text).unwrap().to_string(), "{kind} {text}");
        }
    }

    #[test]
    fn of_several_persons_each_has_a_line() {
        let mut view = full();
        let mut scores = PersonScoresV1 { room_count: 2, persons: 9, person_count: 2, ..Default::default() };
        scores.id[0] = text::encode("id", "kitchen").unwrap();
        scores.id[1] = text::encode("id", "bathroom").unwrap();
        for (number, (person, kitchen)) in (3..).zip(scores.person.iter_mut().zip([0.75, 0.1])) {
            (person.person, person.probability[0], person.probability[1]) = (number, kitchen, 1.0 - kitchen);
        }
        scores.person[1].flags = roomcast_ipc::raw::person_flags::RESTORED;
        view.persons(&scores);
        let text = drawn(&view, 80, 24, BootNs(1_100_000_000));
        for line in [
            "person 3: unknown, next kitchen 75.0 %",
            "person 4: unknown, next bathroom 90.0 %, not observed since the start",
            "and 7 more",
        ] {
            assert!(text.contains(line), "{line:?} is missing:\n{text}");
        }
        scores.person_count = 1;
        view.persons(&scores);
        assert!(!drawn(&view, 80, 24, BootNs(1_100_000_000)).contains("person 3"));
    }

    /// Each person has one line with name, presence, place now and chance of a place elsewhere.
    #[test]
    fn persons_are_shown_by_name_with_their_presence() {
        let mut view = full();
        let mut scores = PersonScoresV1 { epoch: 1, room_count: 2, persons: 2, person_count: 2, ..Default::default() };
        let mut forecasts = PersonForecastsV1 { epoch: 1, room_count: 2, person_count: 2, ..Default::default() };
        (forecasts.horizon_count, forecasts.horizon_s[1]) = (2, 3600.0);
        for (place, id) in ["kitchen", "bathroom"].into_iter().enumerate() {
            (scores.id[place], forecasts.id[place]) =
                (text::encode("id", id).unwrap(), text::encode("id", id).unwrap());
        }
        for (number, name) in [(1, "ada"), (2, "ben")] {
            let place = number as usize - 1;
            (scores.person[place].person, forecasts.person[place].person) = (number, number);
            scores.person[place].name = text::encode("name", name).unwrap();
            scores.person[place].presence = number;
        }
        forecasts.person[1].presence = presence::AWAY;
        (scores.person[0].probability[1], scores.person[0].flags) = (0.5, roomcast_ipc::raw::person_flags::ASLEEP);
        forecasts.person[0].probability[0][0] = 0.875;
        (forecasts.person[1].elsewhere[0], forecasts.person[1].elsewhere[1]) = (1.0, 0.625);
        view.forecasts(&forecasts);
        view.persons(&scores);
        let text = drawn(&view, 80, 24, BootNs(1_100_000_000));
        for line in [
            "ada: present, now kitchen 87.5 %, next bathroom 50.0 %, probably asleep",
            "ben: away, elsewhere in 60 min 62.5 %",
        ] {
            assert!(text.contains(line), "{line:?} is missing:\n{text}");
        }
        // A promised coverage has a line.
        view.status(StatusResponseV1 { learned: 7, ..Default::default() });
        let ada = &mut forecasts.person[0];
        (ada.set_coverage, ada.room_set[1], ada.set_elsewhere, ada.learned_share[1]) = (0.9, 0b10, 0b10, 0.4);
        (ada.probability[1][1], ada.elsewhere[1]) = (0.5, 0.125);
        view.forecasts(&forecasts);
        view.persons(&scores);
        let text = drawn(&view, 80, 24, BootNs(1_100_000_000));
        let line = "in 60 min: bathroom or elsewhere (62 % sure, 40 % learned)";
        assert!(text.contains(line), "{line:?} is missing:\n{text}");
        // Nothing was learned yet: the share would be of the habits' assumptions.
        view.status(StatusResponseV1::default());
        view.persons(&scores);
        let text = drawn(&view, 80, 24, BootNs(1_100_000_000));
        assert!(text.contains("bathroom or elsewhere") && !text.contains("learned)"), "{text}");
        // A line that is too long continues in the next one, between words.
        scores.person[0].name = text::encode("name", "anne-marie of the upper floor").unwrap();
        view.persons(&scores);
        for (width, height) in [(80, 40), (50, 40), (33, 60)] {
            let text = drawn(&view, width, height, BootNs(1_100_000_000));
            let panel = text.lines().skip(1).take_while(|line| !line.contains("narration"));
            let words: Vec<&str> = panel.flat_map(|line| line.trim_matches('│').split_whitespace()).collect();
            let said = words.join(" ");
            for line in &view.persons {
                let line = line.split_whitespace().collect::<Vec<_>>().join(" ");
                assert!(said.contains(&line), "{width}: {line:?} is missing:\n{text}");
            }
        }
        // A single person has a line too if it adds to the rooms' lines.
        (scores.person_count, scores.persons) = (1, 1);
        view.persons(&scores);
        assert!(drawn(&view, 80, 24, BootNs(1_100_000_000)).contains("anne-marie of the upper floor: present"));
    }

    #[test]
    fn a_silent_daemon_and_an_empty_view_are_told() {
        assert!(drawn(&full(), 80, 24, BootNs(9_000_000_000)).contains("daemon silent for 8.0 s"));
        let empty = drawn(&View::default(), 80, 24, BootNs(0));
        assert!(
            empty.contains("no daemon has been heard yet")
                && empty.contains("no decision has been heard yet")
                && empty.contains("nothing since this began"),
            "{empty}"
        );
    }

    #[test]
    fn missed_snapshots_are_counted_and_a_new_map_replaces_the_rooms() {
        let mut view = full();
        view.scores(&scores(34, &[("hall", 1.0)]));
        assert_eq!(view.snapshots_missed, 3);
        assert_eq!(view.rooms.len(), 1);
        assert!(view.rooms[0].points.is_empty());
    }

    #[test]
    fn no_terminal_is_too_small_to_draw() {
        let mut view = full();
        view.help = true;
        for (width, height) in [(1, 1), (10, 3), (40, 8)] {
            drawn(&view, width, height, BootNs(0));
        }
    }
}
