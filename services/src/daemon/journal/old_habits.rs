//! The file format of the habits of an earlier version.

use roomcast_core::habits::Stored;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

const MAGIC: &[u8] = b"RCHABITS";
const VERSION_MAX: u16 = 4;

/// Reads the file's part with the habits.
///
/// # Errors
/// When the bytes are damaged or of another version: the reason.
pub(super) fn stored(bytes: &[u8]) -> Result<Stored, String> {
    let rest = bytes.strip_prefix(MAGIC).ok_or("the habits in it do not begin as habits")?;
    let (version, _) = rest.split_first_chunk().ok_or("it ends early")?;
    let version = u16::from_le_bytes(*version);
    if version > VERSION_MAX {
        return Err(format!("its habits are of version {version}, this program reads up to {VERSION_MAX}"));
    }
    let (body, sum) = rest.split_last_chunk::<16>().ok_or("it ends early")?;
    if !Sha256::new().chain_update(MAGIC).chain_update(body).finalize().starts_with(sum) {
        return Err("the checksum of the habits is wrong".to_owned());
    }
    // The version and unused bytes.
    let mut read = Reader(body.get(10..).ok_or("it ends early")?);
    let stored = read.stored(version).filter(|_| read.0.is_empty()).ok_or("its length is wrong")?;
    serde_json::from_value(stored).map_err(|error| error.to_string())
}

struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (taken, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*taken)
    }

    fn short(&mut self) -> Option<u16> {
        self.take().map(u16::from_le_bytes)
    }

    fn long(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn single(&mut self) -> Option<f32> {
        self.take().map(f32::from_le_bytes)
    }

    fn double(&mut self) -> Option<f64> {
        self.take().map(f64::from_le_bytes)
    }

    /// Reads a list; memory grows only with the bytes that are present.
    fn list<T>(&mut self, mut one: impl FnMut(&mut Self) -> Option<T>) -> Option<Vec<T>> {
        (0..self.long()?).map(|_| one(self)).collect()
    }

    fn name(&mut self) -> Option<Value> {
        let length = self.long()? as usize;
        let (name, rest) = self.0.split_at_checked(length)?;
        self.0 = rest;
        // The minute when it was last seen.
        self.long()?;
        Some(json!({"name": std::str::from_utf8(name).ok()?}))
    }

    fn anchor(&mut self) -> Option<Value> {
        self.list(Self::double)?;
        Some(json!({
            "stayed": self.double()?,
            "sampled": self.double()?,
            "miss": self.double()?,
            "outcomes": self.take().map(u64::from_le_bytes)?,
            "scores": self.list(Self::single)?,
        }))
    }

    fn person(&mut self) -> Option<Value> {
        let (number, slot, observations) = (self.long()?, self.take::<1>()?[0], self.double()?);
        self.take::<16>()?;
        Some(json!({
            "number": number,
            "slot": slot,
            "observations": observations,
            "repeated": [self.double()?, self.double()?],
            "weights": self.list(Self::double)?,
            "anchors": self.list(Self::anchor)?,
        }))
    }

    fn row(&mut self) -> Option<Value> {
        let [kind, slot] = self.take()?;
        Some(json!({
            "kind": kind,
            "slot": slot,
            "after": [self.short()?, self.short()?, self.short()?],
            "touched_min": self.long()?,
            "counts": self.list(|read| Some((read.short()?, read.single()?)))?,
        }))
    }

    fn stored(&mut self, version: u16) -> Option<Value> {
        Some(json!({
            "version": version,
            "objects": self.list(Self::name)?,
            "places": self.list(Self::name)?,
            "persons": self.list(Self::person)?,
            "rows": self.list(Self::row)?,
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::habits::{Habits, HabitsOptions, Place, Turn};
    use roomcast_core::ids::PersonId;

    /// Appends a value: lists with their length, numbers by the width that the file has for their key.
    fn write(out: &mut Vec<u8>, key: &str, value: &Value) {
        match (key, value) {
            ("anchors", Value::Array(anchors)) => {
                out.extend(u32::try_from(anchors.len()).unwrap().to_le_bytes());
                for anchor in anchors {
                    out.extend([0; 4]);
                    for key in ["stayed", "sampled", "miss"] {
                        write(out, key, &anchor[key]);
                    }
                    out.extend([0; 8]);
                    write(out, "scores", &anchor["scores"]);
                }
            }
            ("repeated" | "after", Value::Array(numbers)) => {
                numbers.iter().for_each(|number| write(out, key, number));
            }
            ("counts", Value::Array(counts)) => {
                out.extend(u32::try_from(counts.len()).unwrap().to_le_bytes());
                for count in counts {
                    write(out, "after", &count[0]);
                    write(out, "score", &count[1]);
                }
            }
            (_, Value::Array(values)) => {
                out.extend(u32::try_from(values.len()).unwrap().to_le_bytes());
                values.iter().for_each(|value| write(out, key.trim_end_matches('s'), value));
            }
            (_, Value::String(text)) => {
                out.extend(u32::try_from(text.len()).unwrap().to_le_bytes());
                out.extend(text.as_bytes());
            }
            ("slot" | "kind", number) => out.push(u8::try_from(number.as_u64().unwrap()).unwrap()),
            ("after", number) => out.extend(u16::try_from(number.as_u64().unwrap()).unwrap().to_le_bytes()),
            ("number" | "touched_min", number) => {
                out.extend(u32::try_from(number.as_u64().unwrap()).unwrap().to_le_bytes());
            }
            ("score", number) => out.extend((number.as_f64().unwrap() as f32).to_le_bytes()),
            ("object" | "place", name) => {
                write(out, "name", &name["name"]);
                out.extend([0; 4]);
            }
            ("person", person) => {
                ["number", "slot", "observations"].iter().for_each(|key| write(out, key, &person[key]));
                out.extend([0; 16]);
                ["repeated", "weights", "anchors"].iter().for_each(|key| write(out, key, &person[key]));
            }
            ("row", row) => {
                ["kind", "slot", "after", "touched_min", "counts"].iter().for_each(|key| write(out, key, &row[key]));
            }
            (_, number) => out.extend(number.as_f64().unwrap().to_le_bytes()),
        }
    }

    fn file(habits: &Habits) -> Vec<u8> {
        let stored = serde_json::to_value(habits.stored()).unwrap();
        let mut out = [MAGIC, &4u16.to_le_bytes(), &[0; 8]].concat();
        ["objects", "places", "persons", "rows"].iter().for_each(|key| write(&mut out, key, &stored[key]));
        let sum = Sha256::digest(&out);
        out.extend(&sum[..16]);
        out
    }

    #[test]
    fn a_file_of_an_earlier_version_is_read_whole_or_not_at_all() {
        let mut habits = Habits::new(HabitsOptions::default());
        habits.bind(vec!["mug".to_owned(), "bed".to_owned()], vec!["kitchen".to_owned()], vec![1.0, 1.0]);
        for step in 0..200 {
            let at_s = 1e9 + 60.0 * f64::from(step);
            let label = Some(usize::from(step % 3 == 0));
            habits.mix(PersonId(7), at_s, &[0.5; 2]);
            habits.observe(&Turn { person: PersonId(7), label, room: Some(0), at_s });
            habits.be(PersonId(7), if step % 40 < 30 { Place::Room(0) } else { Place::Elsewhere }, at_s);
            habits.tick(PersonId(7), at_s, &mut |_, p| p.fill(0.5));
        }
        let bytes = file(&habits);
        assert_eq!(stored(&bytes).unwrap().version, VERSION_MAX);
        let read = Habits::from_stored(HabitsOptions::default(), stored(&bytes).unwrap()).unwrap();
        // The weights are learned again.
        let without_weights = |habits: &Habits| {
            let mut stored = serde_json::to_value(habits.stored()).unwrap();
            stored["persons"][0]["weights"].take();
            stored
        };
        assert_eq!(without_weights(&read), without_weights(&habits));
        for at in (0..bytes.len()).step_by(101) {
            let mut other = bytes.clone();
            other[at] ^= 0x10;
            assert!(stored(&other).is_err() && stored(&bytes[..at]).is_err(), "{at}");
        }
    }
}
