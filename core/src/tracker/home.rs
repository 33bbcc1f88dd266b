//! The home as the tracker sees it: rooms, doors, walking times and ways out.

use super::TrackerError;
use crate::grounding::Partition;
use crate::semantic_map::SemanticMap;

/// Most rooms of a home: occupancy is a set of 64 bits.
pub const ROOMS_MAX: usize = 64;
/// Walking speed inside a home, in metres per second.
const WALKING_M_S: f64 = 1.0;
/// Shortest and longest time to cross a room, in seconds.
const CROSSING_S: (f64, f64) = (2.0, 10.0);

/// The usual use of a room. It chooses the stays that the tracker assumes before it knows the home.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, strum::EnumString, strum::Display)]
#[strum(serialize_all = "kebab-case")]
pub enum RoomUse {
    /// People sleep here.
    Bedroom,
    /// A bathroom or a toilet.
    Bathroom,
    /// People cook here.
    Kitchen,
    /// A living or dining room.
    Living,
    /// People work here.
    Office,
    /// A hall, a corridor or stairs: a way to other rooms.
    Hall,
    /// Any other room.
    Other,
}

impl RoomUse {
    /// The use that a room's label names.
    #[must_use]
    pub fn of(label: &str) -> Self {
        const WORDS: [(RoomUse, &[&str]); 6] = [
            (RoomUse::Bedroom, &["bed", "sleep", "nursery", "guest"]),
            (RoomUse::Bathroom, &["bath", "toilet", "shower", "wc", "restroom", "washroom"]),
            (RoomUse::Kitchen, &["kitchen"]),
            (RoomUse::Living, &["living", "dining", "lounge", "family", "sitting"]),
            (RoomUse::Office, &["office", "study", "work"]),
            (RoomUse::Hall, &["hall", "corridor", "entr", "foyer", "stairs", "landing", "lobby", "vestibule"]),
        ];
        let label = label.to_lowercase();
        let named = |words: &[&str]| words.iter().any(|word| label.contains(word));
        WORDS.iter().find(|(_, words)| named(words)).map_or(Self::Other, |(own, _)| *own)
    }
}

/// A room: its use and the time to cross it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Room {
    usage: RoomUse,
    crossing_s: f64,
    /// Weight of its way out of the house; 0 if the room has none.
    way_out: f64,
}

/// Rooms and doors. A person changes rooms through doors only, and leaves the house through a way out only.
#[derive(Debug, Clone, PartialEq)]
pub struct Home {
    rooms: Vec<Room>,
    /// Row by row: whether a door joins two rooms.
    doors: Vec<bool>,
    /// Row by row, rooms + 1 columns: the next room on the shortest way to a room or, last column, out of the house.
    /// `None` where no way leads.
    hops: Vec<Option<usize>>,
    /// Row by row: doors on the shortest way between two rooms; `usize::MAX` where no way leads.
    steps: Vec<usize>,
}

impl Home {
    /// A home with the given room uses, doors and weights of the ways out.
    ///
    /// If no room has a way out, then every hall has one, and every room if the home has no hall.
    ///
    /// # Errors
    /// [`TrackerError::Rooms`] for no room or more than [`ROOMS_MAX`], and [`TrackerError::Unknown`] for a door of a room that does not exist.
    pub fn new(rooms: &[RoomUse], doors: &[(usize, usize)], ways_out: &[f64]) -> Result<Self, TrackerError> {
        let count = rooms.len();
        if count == 0 || count > ROOMS_MAX {
            return Err(TrackerError::Rooms { rooms: count });
        }
        let mut joined = vec![false; count * count];
        for &(a, b) in doors {
            if a >= count || b >= count {
                return Err(TrackerError::Unknown { what: "room", index: a.max(b) });
            }
            joined[a * count + b] = a != b;
            joined[b * count + a] = a != b;
        }
        // A room without a door would be out of reach: its door is unknown.
        for room in 0..count {
            if (0..count).all(|other| !joined[room * count + other]) {
                for other in (0..count).filter(|other| *other != room) {
                    joined[room * count + other] = true;
                    joined[other * count + room] = true;
                }
            }
        }
        let weight = |room: usize| ways_out.get(room).copied().filter(|w| w.is_finite() && *w > 0.0).unwrap_or(0.0);
        let is_given = (0..count).any(|room| weight(room) > 0.0);
        let has_hall = rooms.contains(&RoomUse::Hall);
        let guess = |usage: RoomUse| if !has_hall || usage == RoomUse::Hall { 1.0 } else { 0.0 };
        let of = |(room, usage): (usize, &RoomUse)| Room {
            usage: *usage,
            crossing_s: 4.0,
            way_out: if is_given { weight(room) } else { guess(*usage) },
        };
        let rooms: Vec<Room> = rooms.iter().enumerate().map(of).collect();
        let mut own = Self { rooms, doors: joined, hops: Vec::new(), steps: Vec::new() };
        own.find_ways();
        Ok(own)
    }

    /// The partitions of a map. Two partitions are joined if they share a room or if a door joins their rooms.
    ///
    /// # Errors
    /// As [`Home::new`].
    pub fn of(map: &SemanticMap, partitions: &[Partition], ways_out: &[f64]) -> Result<Self, TrackerError> {
        let uses: Vec<RoomUse> = partitions.iter().map(|own| RoomUse::of(&own.label)).collect();
        let mut doors = Vec::new();
        for (here, own) in partitions.iter().enumerate() {
            for (there, other) in partitions.iter().enumerate().skip(here + 1) {
                let shares = own.rooms.iter().any(|room| other.rooms.contains(room));
                let mut between = map.doors().iter().map(|door| door.rooms);
                let joins = |[a, b]: [crate::semantic_map::RoomId; 2]| {
                    own.rooms.contains(&a) && other.rooms.contains(&b)
                        || own.rooms.contains(&b) && other.rooms.contains(&a)
                };
                if shares || between.any(joins) {
                    doors.push((here, there));
                }
            }
        }
        let mut home = Self::new(&uses, &doors, ways_out)?;
        for (room, own) in home.rooms.iter_mut().zip(partitions) {
            let spaces =
                own.rooms.iter().filter_map(|id| map.rooms().get(id.0 as usize)).map(|room| &room.space.bounds);
            let across_m = spaces.map(|bounds| bounds.size_m()).map(|[x, y, _]| 0.5 * (x + y)).fold(0.0, f64::max);
            if across_m.is_finite() && across_m > 0.0 {
                room.crossing_s = (across_m / WALKING_M_S).clamp(CROSSING_S.0, CROSSING_S.1);
            }
        }
        Ok(home)
    }

    /// Number of rooms.
    #[must_use]
    pub fn rooms(&self) -> usize {
        self.rooms.len()
    }

    /// The use of a room; [`RoomUse::Other`] for a room that does not exist.
    #[must_use]
    pub fn usage(&self, room: usize) -> RoomUse {
        self.rooms.get(room).map_or(RoomUse::Other, |room| room.usage)
    }

    /// Time to cross a room, in seconds.
    pub(super) fn crossing_s(&self, room: usize) -> f64 {
        self.rooms[room].crossing_s
    }

    /// Weight of a room's way out; 0 if the room has none.
    #[must_use]
    pub fn way_out(&self, room: usize) -> f64 {
        self.rooms.get(room).map_or(0.0, |room| room.way_out)
    }

    /// Whether a door joins two rooms.
    #[must_use]
    pub fn are_joined(&self, a: usize, b: usize) -> bool {
        a < self.rooms() && b < self.rooms() && self.doors[a * self.rooms() + b]
    }

    /// The next room on the way to another room. The room itself if the destination is elsewhere (`None`) and the room has a way out.
    #[must_use]
    pub fn hop(&self, from: usize, to: Option<usize>) -> Option<usize> {
        self.hops.get(from * (self.rooms() + 1) + to.unwrap_or(self.rooms())).copied().flatten()
    }

    /// Doors on the way from a room to the nearest way out.
    pub(super) fn steps_out(&self, from: usize) -> usize {
        let exits = (0..self.rooms()).filter(|room| self.rooms[*room].way_out > 0.0);
        exits.map(|room| self.steps[from * self.rooms() + room]).min().unwrap_or(usize::MAX)
    }

    /// Breadth-first search to every room, and to the nearest way out.
    fn find_ways(&mut self) {
        let count = self.rooms();
        self.steps = vec![usize::MAX; count * count];
        for from in 0..count {
            let mut queue = std::collections::VecDeque::from([from]);
            self.steps[from * count + from] = 0;
            while let Some(here) = queue.pop_front() {
                for next in (0..count).filter(|next| self.doors[here * count + next]) {
                    if self.steps[from * count + next] == usize::MAX {
                        self.steps[from * count + next] = self.steps[from * count + here] + 1;
                        queue.push_back(next);
                    }
                }
            }
        }
        let mut hops = vec![None; count * (count + 1)];
        for from in 0..count {
            let toward = |to: usize| {
                let next = (0..count).filter(|next| self.doors[from * count + next]);
                next.min_by_key(|next| self.steps[next * count + to])
                    .filter(|next| self.steps[next * count + to] != usize::MAX)
            };
            for to in (0..count).filter(|to| *to != from) {
                hops[from * (count + 1) + to] = toward(to);
            }
            let exits = (0..count).filter(|room| self.rooms[*room].way_out > 0.0);
            let nearest = exits.min_by_key(|room| self.steps[from * count + room]);
            hops[from * (count + 1) + count] =
                nearest.and_then(|exit| if exit == from { Some(from) } else { toward(exit) });
        }
        self.hops = hops;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ways_lead_through_the_rooms_between() {
        // Bedroom, bathroom and kitchen open into the hall.
        let uses = [RoomUse::Bedroom, RoomUse::Hall, RoomUse::Bathroom, RoomUse::Kitchen];
        let home = Home::new(&uses, &[(0, 1), (1, 2), (1, 3)], &[]).unwrap();
        assert_eq!(home.hop(0, Some(2)), Some(1));
        assert_eq!(home.hop(1, Some(2)), Some(2));
        assert_eq!((home.hop(0, None), home.hop(1, None)), (Some(1), Some(1)));
        assert_eq!((home.steps_out(2), home.way_out(1), home.way_out(0)), (1, 1.0, 0.0));
    }

    #[test]
    fn homes_without_rooms_and_doors_to_unknown_rooms_are_refused() {
        assert!(Home::new(&[], &[], &[]).is_err());
        assert!(Home::new(&[RoomUse::Hall], &[(0, 1)], &[]).is_err());
        assert!(Home::new(&[RoomUse::Other; 65], &[], &[]).is_err());
    }

    #[test]
    fn labels_name_the_use_of_a_room() {
        assert_eq!(RoomUse::of("Master bedroom"), RoomUse::Bedroom);
        assert_eq!(RoomUse::of("bathroom"), RoomUse::Bathroom);
        assert_eq!(RoomUse::of("hallway"), RoomUse::Hall);
        assert_eq!(RoomUse::of("garage"), RoomUse::Other);
    }
}
