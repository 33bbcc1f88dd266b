//! Floor plans and the devices in them.

use roomcast_core::tracker::{Home, RoomUse, SensorKind, SensorSpec, TrackerError};

#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    pub names: Vec<String>,
    /// The same home as the tracker knows it.
    pub home: Home,
    /// Per resident, the bedroom.
    pub bedrooms: Vec<u8>,
    /// The hall with the front door.
    pub hall: u8,
}

/// A kind of device that a home may lack.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, strum::EnumString, strum::Display, strum::VariantNames)]
#[strum(serialize_all = "kebab-case")]
pub enum Device {
    Presence,
    Bed,
    Phone,
    Door,
    Appliance,
    Camera,
}

impl Plan {
    /// A home for one to four residents: five, six, seven or ten rooms.
    pub fn of_residents(residents: usize) -> Result<Self, TrackerError> {
        let mut names = vec!["bedroom", "hallway", "bathroom", "kitchen", "living room"];
        let mut doors = vec![(0, 1), (2, 1), (3, 1), (4, 1), (3, 4)];
        let mut bedrooms: Vec<u8> = vec![0, 0];
        if residents >= 2 {
            names.push("office");
            doors.push((5, 1));
        }
        if residents >= 3 {
            names.push("child's bedroom");
            doors.push((6, 1));
            bedrooms.push(6);
        }
        if residents >= 4 {
            names.extend(["landing", "guest bedroom", "upstairs bathroom"]);
            // The children sleep upstairs.
            doors.retain(|door| *door != (6, 1));
            doors.extend([(7, 1), (6, 7), (8, 7), (9, 7)]);
            bedrooms.push(8);
        }
        bedrooms.truncate(residents.max(1));
        Self::new(&names, &doors, bedrooms, 1)
    }

    pub fn new(names: &[&str], doors: &[(usize, usize)], bedrooms: Vec<u8>, hall: u8) -> Result<Self, TrackerError> {
        let uses: Vec<RoomUse> = names.iter().map(|name| RoomUse::of(name)).collect();
        let exits: Vec<f64> = (0..names.len()).map(|room| if room == usize::from(hall) { 1.0 } else { 0.0 }).collect();
        let home = Home::new(&uses, doors, &exits)?;
        Ok(Self { names: names.iter().map(ToString::to_string).collect(), home, bedrooms, hall })
    }

    /// The first room of a use; people use the living room for the rooms that a home lacks.
    pub fn room(&self, usage: RoomUse) -> u8 {
        let find = |usage| (0..self.home.rooms()).find(|room| self.home.usage(*room) == usage);
        find(usage).or_else(|| find(RoomUse::Living)).map_or(self.hall, |room| room as u8)
    }

    /// The home's sensors without the kinds that it lacks.
    pub fn sensors(&self, without: &[Device]) -> Vec<SensorSpec> {
        let has = |device: Device| !without.contains(&device);
        let mut specs = Vec::new();
        for room in 0..self.home.rooms() {
            match self.home.usage(room) {
                RoomUse::Living | RoomUse::Office if has(Device::Presence) => {
                    specs.push(SensorSpec::of_room(SensorKind::Presence, room));
                }
                _ => specs.push(SensorSpec::of_room(SensorKind::Motion, room)),
            }
        }
        for (person, room) in self.bedrooms.iter().enumerate() {
            if has(Device::Bed) {
                let of = SensorSpec::of_room(SensorKind::Bed, usize::from(*room));
                specs.push(SensorSpec { person: Some(person), ..of });
            }
            if has(Device::Phone) {
                specs.push(SensorSpec::phone(person));
            }
        }
        if has(Device::Door) {
            specs.push(SensorSpec::of_room(SensorKind::Door, usize::from(self.hall)));
        }
        if has(Device::Appliance) {
            specs.push(SensorSpec::of_room(SensorKind::Appliance, usize::from(self.room(RoomUse::Kitchen))));
        }
        specs
    }
}
