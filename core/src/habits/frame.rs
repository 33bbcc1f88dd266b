//! The map that is in use now, by the numbers of its words: counts go by words, forecasts by the map's labels and rooms.

/// The number of "elsewhere": out of the house, or outside the map.
pub(crate) const ELSEWHERE: u16 = 0;

/// Labels and rooms of a map, and the numbers of their words.
#[derive(Debug, Clone, Default)]
pub(crate) struct Frame {
    pub(crate) labels: Vec<String>,
    pub(crate) rooms: Vec<String>,
    /// Per label and room, row by row, the share of the label's items that lie there.
    pub(crate) shares: Vec<f64>,
    /// By number. A map can have more labels than there are numbers.
    label_of: Vec<Option<usize>>,
    number_of: Vec<Option<u16>>,
    place_of: Vec<Option<usize>>,
    number_of_place: Vec<Option<u16>>,
}

fn enter<T: Copy>(at: usize, value: T, table: &mut Vec<Option<T>>) {
    if table.len() <= at {
        table.resize(at + 1, None);
    }
    table[at] = Some(value);
}

fn look<T: Copy>(at: usize, table: &[Option<T>]) -> Option<T> {
    table.get(at).copied().flatten()
}

impl Frame {
    pub(crate) fn new(labels: Vec<String>, rooms: Vec<String>, shares: Vec<f64>) -> Self {
        let number_of = vec![None; labels.len()];
        let number_of_place = vec![None; rooms.len() + 1];
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
        enter(usize::from(number), label, &mut self.label_of);
    }

    pub(crate) fn name_place(&mut self, place: usize, number: u16) {
        enter(place, number, &mut self.number_of_place);
        enter(usize::from(number), place, &mut self.place_of);
    }

    /// A number now stands for something else.
    pub(crate) fn drop_number(&mut self, number: u16) {
        if let Some(label) = self.label(number) {
            self.number_of[label] = None;
            self.label_of[usize::from(number)] = None;
        }
    }

    /// As [`Frame::drop_number`], of a place.
    pub(crate) fn drop_place_number(&mut self, number: u16) {
        if let Some(place) = self.place(number) {
            self.number_of_place[place] = None;
            self.place_of[usize::from(number)] = None;
        }
    }

    /// The label with this number, if the map has it.
    pub(crate) fn label(&self, number: u16) -> Option<usize> {
        look(usize::from(number), &self.label_of)
    }

    pub(crate) fn label_number(&self, label: usize) -> Option<u16> {
        look(label, &self.number_of)
    }

    /// The place with this number, if the map has it.
    pub(crate) fn place(&self, number: u16) -> Option<usize> {
        look(usize::from(number), &self.place_of)
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

#[cfg(test)]
mod tests {
    use super::*;

    /// A map may have 100 000 labels, more than 16 bits count.
    #[test]
    fn a_label_of_any_place_is_itself() {
        let labels = (0..70_000).map(|label| format!("thing {label}")).collect();
        let mut frame = Frame::new(labels, vec!["kitchen".to_owned()], Vec::new());
        for (number, label) in [(1, 65_534), (2, 65_535), (3, 65_536), (4, 65_541), (5, 69_999)] {
            frame.name_label(label, number);
        }
        for (number, label) in [(1, 65_534), (2, 65_535), (3, 65_536), (4, 65_541), (5, 69_999)] {
            assert_eq!((frame.label(number), frame.label_number(label)), (Some(label), Some(number)));
        }
        assert_eq!((frame.label_number(0), frame.label_number(5)), (None, None), "not one with the same low bits");
        frame.drop_number(4);
        assert_eq!((frame.label(4), frame.label_number(65_541), frame.label_number(5)), (None, None, None));
    }
}
