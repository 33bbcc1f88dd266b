//! Definitions of the messages as text for recordings: fields alone.

use crate::types::Message;

/// Separates a definition from the next one that it needs.
const LINE: &str = "================================================================================";

/// The fields of each type, with types by their full names.
const FIELDS: [(&str, &str); 22] = [
    ("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n"),
    ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"),
    ("diagnostic_msgs/DiagnosticArray", "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n"),
    (
        "diagnostic_msgs/DiagnosticStatus",
        "byte level\nstring name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values\n",
    ),
    ("diagnostic_msgs/KeyValue", "string key\nstring value\n"),
    ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/Pose", "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"),
    ("geometry_msgs/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"),
    ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
    (
        "nav2_msgs/CostmapFilterInfo",
        "std_msgs/Header header\nuint8 type\nstring filter_mask_topic\nfloat32 base\nfloat32 multiplier\n",
    ),
    (
        "nav_msgs/MapMetaData",
        "builtin_interfaces/Time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\ngeometry_msgs/Pose origin\n",
    ),
    ("nav_msgs/OccupancyGrid", "std_msgs/Header header\nnav_msgs/MapMetaData info\nint8[] data\n"),
    ("sensor_msgs/CompressedImage", "std_msgs/Header header\nstring format\nuint8[] data\n"),
    ("std_msgs/ColorRGBA", "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n"),
    ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"),
    ("std_msgs/String", "string data\n"),
    ("vision_msgs/Classification", "std_msgs/Header header\nvision_msgs/ObjectHypothesis[] results\n"),
    ("vision_msgs/ObjectHypothesis", "string class_id\nfloat64 score\n"),
    (
        "visualization_msgs/Marker",
        "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose pose\n\
         geometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\nbool frame_locked\n\
         geometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\nstring texture_resource\n\
         sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] uv_coordinates\nstring text\n\
         string mesh_resource\nvisualization_msgs/MeshFile mesh_file\nbool mesh_use_embedded_materials\n",
    ),
    ("visualization_msgs/MarkerArray", "visualization_msgs/Marker[] markers\n"),
    ("visualization_msgs/MeshFile", "string filename\nuint8[] data\n"),
    ("visualization_msgs/UVCoordinate", "float32 u\nfloat32 v\n"),
];

fn fields(name: &str) -> Option<&'static str> {
    FIELDS.iter().find(|(known, _)| *known == name).map(|(_, fields)| *fields)
}

fn nested(fields: &str) -> impl Iterator<Item = &str> {
    let kinds = fields.lines().filter_map(|field| field.split(' ').next());
    kinds.map(|kind| kind.trim_end_matches("[]")).filter(|kind| kind.contains('/'))
}

/// The definition of a message, with the definitions of all types in it, in the encoding `ros2msg`.
#[must_use]
pub fn of<M: Message>() -> String {
    let own = M::NAME.replace("/msg/", "/");
    let mut names = vec![own.as_str()];
    let mut text = String::new();
    let mut at = 0;
    while let Some(name) = names.get(at).copied() {
        let fields = fields(name).unwrap_or_default();
        if at > 0 {
            text += &format!("{LINE}\nMSG: {name}\n");
        }
        text += fields;
        for other in nested(fields) {
            if !names.contains(&other) {
                names.push(other);
            }
        }
        at += 1;
    }
    text
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use sha2::{Digest, Sha256};

    use super::*;
    use crate::types::{Classification, CostmapFilterInfo, DiagnosticArray, MarkerArray, OccupancyGrid, Text};

    /// The types of a definition; the first is its own.
    fn types<M: Message>() -> Vec<(String, Vec<(String, String)>)> {
        let text = of::<M>();
        let between = format!("{LINE}\nMSG: ");
        let mut parts = text.split(&between);
        let lines = |fields: &str| {
            let pair =
                |line: &str| line.split_once(' ').map(|(kind, name)| (kind.to_owned(), name.to_owned())).unwrap();
            fields.lines().map(pair).collect()
        };
        let own = (M::NAME.to_owned(), lines(parts.next().unwrap()));
        let others = parts.map(|part| {
            let (name, fields) = part.split_once('\n').unwrap();
            (name.replace('/', "/msg/"), lines(fields))
        });
        [own].into_iter().chain(others).collect()
    }

    fn described((name, fields): &(String, Vec<(String, String)>)) -> String {
        let fields = fields.iter().map(|(kind, name)| {
            let (one, more) = kind.strip_suffix("[]").map_or((kind.as_str(), 0), |one| (one, 144));
            let nested = if one.contains('/') { one.replace('/', "/msg/") } else { String::new() };
            let number = match one {
                "int8" => 2,
                "uint8" => 3,
                "int32" => 6,
                "uint32" => 7,
                "float32" => 10,
                "float64" => 11,
                "bool" => 15,
                "byte" => 16,
                "string" => 17,
                _ if !nested.is_empty() => 1,
                other => panic!("{other}"),
            };
            let kind = format!("\"type_id\": {}, \"capacity\": 0, \"string_capacity\": 0", number + more);
            format!("{{\"name\": \"{name}\", \"type\": {{{kind}, \"nested_type_name\": \"{nested}\"}}}}")
        });
        let fields: Vec<_> = fields.collect();
        format!("{{\"type_name\": \"{name}\", \"fields\": [{}]}}", fields.join(", "))
    }

    fn hash<M: Message>() -> String {
        let types = types::<M>();
        let others: BTreeMap<_, _> = types[1..].iter().map(|one| (one.0.clone(), described(one))).collect();
        let others: Vec<_> = others.into_values().collect();
        let whole = format!(
            "{{\"type_description\": {}, \"referenced_type_descriptions\": [{}]}}",
            described(&types[0]),
            others.join(", ")
        );
        format!("RIHS01_{}", hex::encode(Sha256::digest(whole)))
    }

    #[test]
    fn each_definition_has_the_hash_that_ros_2_knows_its_type_by() {
        fn holds<M: Message>() {
            assert_eq!(hash::<M>(), M::HASH, "{}", M::NAME);
        }
        holds::<Text>();
        holds::<Classification>();
        holds::<MarkerArray>();
        holds::<OccupancyGrid>();
        holds::<CostmapFilterInfo>();
        holds::<DiagnosticArray>();
    }
}
