//! The map that is in use now, by the numbers of its words: counts go by words, forecasts by the map's labels and rooms.

use super::key::NONE;

/// The number of "elsewhere": out of the house, or outside the map.
pub(crate) const ELSEWHERE: u16 = 0;

/// Labels and rooms of a map, and the numbers of their words.
#[derive(Debug, Clone, Default)]
pub(crate) struct Frame {
    pub(crate) labels: Vec<String>,
    pub(crate) rooms: Vec<String>,
    /// Per label and room, row by row, the share of the label's items that lie there.
    pub(crate) shares: Vec<f64>,
    label_of: Vec<u16>,
    number_of: Vec<u16>,
    place_of: Vec<u16>,
    number_of_place: Vec<u16>,
}

fn enter(at: usize, value: u16, table: &mut Vec<u16>) {
    if table.len() <= at {
        table.resize(at + 1, NONE);
    }
    table[at] = value;
}

fn look(at: usize, table: &[u16]) -> Option<u16> {
    table.get(at).copied().filter(|value| *value != NONE)
}

impl Frame {
    pub(crate) fn new(labels: Vec<String>, rooms: Vec<String>, shares: Vec<f64>) -> Self {
        let number_of = vec![NONE; labels.len()];
        let number_of_place = vec![NONE; rooms.len() + 1];
        let mut frame = Self { labels, rooms, shares, number_of, number_of_place, ..Self::default() };
        frame.name_place(frame.elsewhere(), ELSEWHERE);
        frame
    }

    /// Rooms and elsewhere.
    pub(crate) fn places(&self) -> usize {
        self.rooms.len() + 1
    }

    /// The index of elsewhere among the places.
    pub(crate) fn elsewhere(&self) -> usize {
        self.rooms.len()
    }

    pub(crate) fn name_label(&mut self, label: usize, number: u16) {
        enter(label, number, &mut self.number_of);
        enter(usize::from(number), label as u16, &mut self.label_of);
    }

    pub(crate) fn name_place(&mut self, place: usize, number: u16) {
        enter(place, number, &mut self.number_of_place);
        enter(usize::from(number), place as u16, &mut self.place_of);
    }

    /// A number now stands for something else.
    pub(crate) fn drop_number(&mut self, number: u16) {
        if let Some(label) = self.label(number) {
            self.number_of[label] = NONE;
            self.label_of[usize::from(number)] = NONE;
        }
    }

    /// As [`Frame::drop_number`], of a place.
    pub(crate) fn drop_place_number(&mut self, number: u16) {
        if let Some(place) = self.place(number) {
            self.number_of_place[place] = NONE;
            self.place_of[usize::from(number)] = NONE;
        }
    }

    /// The label with this number, if the map has it.
    pub(crate) fn label(&self, number: u16) -> Option<usize> {
        look(usize::from(number), &self.label_of).map(usize::from)
    }

    pub(crate) fn label_number(&self, label: usize) -> Option<u16> {
        look(label, &self.number_of)
    }

    /// The place with this number, if the map has it.
    pub(crate) fn place(&self, number: u16) -> Option<usize> {
        look(usize::from(number), &self.place_of).map(usize::from)
    }

    /// As [`Frame::place`], without elsewhere.
    pub(crate) fn room(&self, number: u16) -> Option<usize> {
        self.place(number).filter(|place| *place < self.rooms.len())
    }

    pub(crate) fn place_number(&self, place: usize) -> Option<u16> {
        look(place, &self.number_of_place)
    }

    /// Per room the share of a label's items that lie there, by the map.
    pub(crate) fn shares_of(&self, label: usize) -> &[f64] {
        let rooms = self.rooms.len();
        self.shares.get(label * rooms..(label + 1) * rooms).unwrap_or_default()
    }

    /// The share of a label's items that lie in a room, by the map.
    pub(crate) fn share(&self, label: usize, room: usize) -> f64 {
        self.shares.get(label * self.rooms.len() + room).copied().unwrap_or(0.0)
    }
}
