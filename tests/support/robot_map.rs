/// A Valetudo map of rectangular rooms: number, name, and x, y, width and height in pixels of 5 cm.
pub(crate) fn robot_map(rooms: &[(&str, &str, [i32; 4])]) -> String {
    let block = |(number, name, [x, y, wide, high]): &(&str, &str, [i32; 4])| {
        let runs: Vec<i32> = (*y..y + high).flat_map(|row| [*x, row, *wide]).collect();
        serde_json::json!({"__class": "MapLayer", "type": "segment", "metaData": {"segmentId": number, "name": name, "active": false},
            "compressedPixels": runs})
    };
    let layers: Vec<_> = rooms.iter().map(block).collect();
    serde_json::json!({"__class": "ValetudoMap", "metaData": {"version": 2}, "size": {"x": 5120, "y": 5120}, "pixelSize": 5,
        "layers": layers, "entities": []})
    .to_string()
}
