//! The ROS 2 messages, field by field in the order of their definitions, with the names and hashes by which rmw_zenoh distinguishes types.
//! A test computes every hash from the definition in [`crate::schema`]; the bridge's tests compute them, and decode every message, with
//! other implementations.

pub use cdr_encoding::Error as CdrError;
use cdr_encoding::{from_bytes, to_vec};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// The header of each message in CDR: little endian, no options.
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// A message that is published or received.
pub trait Message {
    /// Its name for people and in recordings.
    const NAME: &'static str;
    /// Its name in keys of rmw_zenoh.
    const TYPE: &'static str;
    /// The hash of its definition (REP 2016).
    const HASH: &'static str;
}

/// A message's bytes: encapsulation and CDR.
///
/// # Errors
///
/// For what CDR cannot hold: a sequence of 2^32 elements or more.
pub fn encode<M: Message + Serialize>(message: &M) -> Result<Vec<u8>, CdrError> {
    let mut bytes = ENCAPSULATION.to_vec();
    bytes.extend(to_vec::<M, byteorder::LittleEndian>(message)?);
    Ok(bytes)
}

/// The bytes are not a message of the type.
#[derive(Debug, thiserror::Error)]
#[error("no {kind} in CDR: {reason}")]
pub struct Malformed {
    kind: &'static str,
    reason: String,
}

/// Decodes a message, in either byte order.
///
/// # Errors
///
/// [`Malformed`] for bytes that are none.
pub fn decode<M: Message + DeserializeOwned>(bytes: &[u8]) -> Result<M, Malformed> {
    let malformed = |reason: String| Malformed { kind: M::NAME, reason };
    let decoded = match bytes {
        [0, 1, _, _, rest @ ..] => from_bytes::<M, byteorder::LittleEndian>(rest),
        [0, 0, _, _, rest @ ..] => from_bytes::<M, byteorder::BigEndian>(rest),
        _ => return Err(malformed("its first four bytes name no encoding".to_owned())),
    };
    decoded.map(|(message, _)| message).map_err(|error| malformed(error.to_string()))
}

/// Decodes the text of a peer's `std_msgs/String`, in either byte order.
///
/// # Errors
///
/// [`Malformed`] for bytes that are none.
pub fn decode_string(bytes: &[u8]) -> Result<String, Malformed> {
    let text = decode::<Text>(bytes)?.data;
    // The decoder accepts any last byte in place of the zero that ends a string. The encoding and the length precede the text.
    if bytes.get(ENCAPSULATION.len() + size_of::<u32>() + text.len()) == Some(&0) {
        Ok(text)
    } else {
        Err(Malformed { kind: Text::NAME, reason: "no zero ends its text".to_owned() })
    }
}

macro_rules! message {
    ($name:ident, $package:literal, $kind:literal, $hash:literal) => {
        impl Message for $name {
            const NAME: &'static str = concat!($package, "/msg/", $kind);
            const TYPE: &'static str = concat!($package, "::msg::dds_::", $kind, "_");
            const HASH: &'static str = concat!("RIHS01_", $hash);
        }
    };
}

/// `std_msgs/String`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Text {
    /// The text.
    pub data: String,
}
message!(Text, "std_msgs", "String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18");

/// `builtin_interfaces/Time` and `Duration`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Time {
    /// Seconds.
    pub sec: i32,
    /// Nanoseconds in addition to them.
    pub nanosec: u32,
}

impl Time {
    /// The time of a wall clock.
    #[must_use]
    pub fn of_unix_ns(unix_ns: u64) -> Self {
        // ROS 2's time ends in 2038.
        let sec = i32::try_from(unix_ns / 1_000_000_000).unwrap_or(i32::MAX);
        Self { sec, nanosec: (unix_ns % 1_000_000_000) as u32 }
    }
}

/// `std_msgs/Header`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// The time of the content.
    pub stamp: Time,
    /// The frame of its coordinates.
    pub frame_id: String,
}

impl Header {
    /// A header for content of this wall clock time.
    #[must_use]
    pub fn of_unix_ns(unix_ns: u64, frame: &str) -> Self {
        Self { stamp: Time::of_unix_ns(unix_ns), frame_id: frame.to_owned() }
    }
}

/// `geometry_msgs/Point` and `Vector3`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// Metres.
    pub x: f64,
    /// Metres.
    pub y: f64,
    /// Metres.
    pub z: f64,
}

/// `geometry_msgs/Quaternion`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Quaternion {
    /// First imaginary part.
    pub x: f64,
    /// Second imaginary part.
    pub y: f64,
    /// Third imaginary part.
    pub z: f64,
    /// Real part.
    pub w: f64,
}

impl Default for Quaternion {
    fn default() -> Self {
        Self { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }
    }
}

/// `geometry_msgs/Pose`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// The position.
    pub position: Point,
    /// The orientation.
    pub orientation: Quaternion,
}

/// `nav_msgs/MapMetaData`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct MapMetaData {
    /// When the map was loaded.
    pub map_load_time: Time,
    /// Metres per cell.
    pub resolution: f32,
    /// Cells from west to east.
    pub width: u32,
    /// Cells from south to north.
    pub height: u32,
    /// The lower left corner of the first cell.
    pub origin: Pose,
}

/// `nav_msgs/OccupancyGrid`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct OccupancyGrid {
    /// Time and frame.
    pub header: Header,
    /// Its place and size.
    pub info: MapMetaData,
    /// 0 to 100 for each cell, row by row from the south.
    pub data: Vec<i8>,
}
message!(
    OccupancyGrid,
    "nav_msgs",
    "OccupancyGrid",
    "8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7"
);

/// `nav2_msgs/CostmapFilterInfo`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CostmapFilterInfo {
    /// Time and frame.
    pub header: Header,
    /// 0: a keepout filter.
    pub r#type: u8,
    /// The topic of the mask.
    pub filter_mask_topic: String,
    /// Cost is base + multiplier times the mask's value.
    pub base: f32,
    /// See `base`.
    pub multiplier: f32,
}
message!(
    CostmapFilterInfo,
    "nav2_msgs",
    "CostmapFilterInfo",
    "61ce391bf7690f76a331c01c9d5ce8ca71e6c99273b9fb75e48380f05c6dfdc8"
);

/// `vision_msgs/ObjectHypothesis`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ObjectHypothesis {
    /// The room.
    pub class_id: String,
    /// Its probability.
    pub score: f64,
}

/// `vision_msgs/Classification`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Classification {
    /// Time and frame.
    pub header: Header,
    /// The rooms.
    pub results: Vec<ObjectHypothesis>,
}
message!(
    Classification,
    "vision_msgs",
    "Classification",
    "f74db28d0eaef3afb78f48bf2161cd709a1383a0309d3454383b25be11345143"
);

/// `std_msgs/ColorRGBA`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ColorRgba {
    /// Red, 0 to 1.
    pub r: f32,
    /// Green.
    pub g: f32,
    /// Blue.
    pub b: f32,
    /// Opacity, 0 to 1.
    pub a: f32,
}

/// `sensor_msgs/CompressedImage`, which is empty here.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CompressedImage {
    /// Empty.
    pub header: Header,
    /// Empty.
    pub format: String,
    /// Empty.
    pub data: Vec<u8>,
}

/// `visualization_msgs/UVCoordinate`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct UvCoordinate {
    /// Zero.
    pub u: f32,
    /// Zero.
    pub v: f32,
}

/// `visualization_msgs/MeshFile`, which is empty here.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct MeshFile {
    /// Empty.
    pub filename: String,
    /// Empty.
    pub data: Vec<u8>,
}

/// `visualization_msgs/Marker`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Marker {
    /// Time and frame.
    pub header: Header,
    /// The namespace; with `id` it identifies the marker.
    pub ns: String,
    /// With `ns` it identifies the marker.
    pub id: i32,
    /// The type: 4 is a line, 9 a text.
    pub r#type: i32,
    /// 0 adds the marker.
    pub action: i32,
    /// Position and orientation.
    pub pose: Pose,
    /// Metres.
    pub scale: Point,
    /// Its colour.
    pub color: ColorRgba,
    /// Zero means for ever.
    pub lifetime: Time,
    /// Whether it moves with its frame.
    pub frame_locked: bool,
    /// The points of a line.
    pub points: Vec<Point>,
    /// Colours of the points; empty.
    pub colors: Vec<ColorRgba>,
    /// Empty.
    pub texture_resource: String,
    /// Empty.
    pub texture: CompressedImage,
    /// Empty.
    pub uv_coordinates: Vec<UvCoordinate>,
    /// The text of a text marker.
    pub text: String,
    /// Empty.
    pub mesh_resource: String,
    /// Empty.
    pub mesh_file: MeshFile,
    /// Always false.
    pub mesh_use_embedded_materials: bool,
}

/// `visualization_msgs/MarkerArray`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct MarkerArray {
    /// The markers.
    pub markers: Vec<Marker>,
}
message!(
    MarkerArray,
    "visualization_msgs",
    "MarkerArray",
    "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf"
);

/// `diagnostic_msgs/KeyValue`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct KeyValue {
    /// The name.
    pub key: String,
    /// The value.
    pub value: String,
}

/// `diagnostic_msgs/DiagnosticStatus`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct DiagnosticStatus {
    /// 0 good, 1 a warning, 2 an error, 3 stale.
    pub level: u8,
    /// The name of the part.
    pub name: String,
    /// The state in words.
    pub message: String,
    /// The machine.
    pub hardware_id: String,
    /// The state in numbers.
    pub values: Vec<KeyValue>,
}

/// `diagnostic_msgs/DiagnosticArray`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct DiagnosticArray {
    /// Time and frame.
    pub header: Header,
    /// The status of each part.
    pub status: Vec<DiagnosticStatus>,
}
message!(
    DiagnosticArray,
    "diagnostic_msgs",
    "DiagnosticArray",
    "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_string_goes_and_comes() {
        let bytes = encode(&Text { data: "hello".to_owned() }).unwrap();
        assert_eq!(bytes, b"\0\x01\0\0\x06\0\0\0hello\0");
        assert_eq!(decode_string(&bytes).unwrap(), "hello");
        assert_eq!(decode_string(b"\0\0\0\0\0\0\0\x03hi\0").unwrap(), "hi");
    }

    #[test]
    fn hostile_strings_are_refused() {
        for bad in [
            b"".as_slice(),
            b"\0\x01\0\0",
            b"\0\x01\0\0\xff\xff\xff\xffhello\0",
            b"\0\x01\0\0\x06\0\0\0hel",
            b"\0\x01\0\0\x03\0\0\0\xff\xfe\0",
            b"\x07\x01\0\0\x06\0\0\0hello\0",
            b"\0\x01\0\0\x02\0\0\0ab",
            b"\0\0\0\0\0\0\0\x02ab\0",
        ] {
            decode_string(bad).unwrap_err();
        }
    }

    proptest::proptest! {
        /// Each text decodes to itself. A text without its final zero is rejected.
        #[test]
        fn a_text_is_read_whole_or_not_at_all(data in "\\PC{0,40}") {
            let bytes = encode(&Text { data: data.clone() }).unwrap();
            proptest::prop_assert_eq!(&decode_string(&bytes).unwrap(), &data);
            let length = (data.len() as u32).to_le_bytes();
            let without = [&ENCAPSULATION, &length, data.as_bytes()].concat();
            proptest::prop_assert!(decode_string(&without).is_err());
        }

        #[test]
        fn any_bytes_are_taken_without_a_panic(bytes in proptest::collection::vec(proptest::num::u8::ANY, 0..64)) {
            let _text = decode_string(&bytes);
            let _text = decode_string(&[&ENCAPSULATION[..], &bytes].concat());
        }
    }
}
