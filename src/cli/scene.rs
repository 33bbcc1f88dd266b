//! `roomcast scene`: imports, checks, shows and draws semantic maps.

use std::collections::HashMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use comfy_table::CellAlignment;
use roomcast_ipc::question;
use serde_json::{Value, json};
use strum::VariantArray;

use super::choice::choice;
#[cfg(feature = "whole")]
use super::draw;
use super::scene_files::{in_file, input, load, read, write};
use super::{CommandResult, Failure, count, print, scene_import, service, table};
use crate::columns::prose;
use crate::exit_code;
use roomcast_core::grounding::{Grounding, GroundingOptions, PartitionLevel, Placement, Reason};
use roomcast_core::semantic_map::delta;
use roomcast_core::semantic_map::{ItemId, PartitionId, Room, RoomId, SemanticMap, Space};
use roomcast_services::daemon::{MapAnswer, MapQuestion, Outcome};
use roomcast_services::setup::{self, SetupError};

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

roomcast_cli::commands! {
    Command;
    /// Turn a map of another format into a scene.
    Import(scene_import::Args) scene_import::run;
    /// Check scenes: the format, and whether every item is in a room and every room can be reached.
    Check(Check) check;
    /// Apply changes to a scene file: items added, moved, removed; rooms added, removed.
    Change(Change) change;
    /// Apply changes to the map of a running daemon, without a restart.
    Apply(Apply) apply;
    /// Print a scene's contents, each item's partition with the rule of the assignment, and the unassigned items.
    Show(Show) show;
    /// Draw a scene from above, with scores as heat, as SVG or PNG.
    ["whole"] Draw(draw::Args) draw::run;
}

#[derive(Debug, clap::Args)]
struct Change {
    /// The scene file, or the name of an included one.
    scene: PathBuf,
    /// A JSON list of changes; scenes/README.md documents them.
    changes: PathBuf,
    /// The scene to write.
    #[arg(long)]
    out: PathBuf,
}

#[derive(Debug, clap::Args)]
struct Apply {
    #[command(flatten)]
    asking: service::Asking,
    /// A JSON list of changes, `-` for standard input; scenes/README.md documents them.
    changes: PathBuf,
    /// Apply them only if the map in use has this fingerprint (`roomcast scene show --json` of its file prints it).
    #[arg(long, value_name = "HEX")]
    expect: Option<String>,
    /// Print the daemon's answer as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
struct Check {
    /// The scene files, or names of shipped ones.
    #[arg(required = true)]
    scenes: Vec<PathBuf>,
    /// Fail for warnings, too.
    #[arg(long)]
    strict: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
struct Show {
    /// The scene file, or the name of an included one.
    scene: PathBuf,
    /// The level of a partition.
    #[arg(long, value_parser = choice::<PartitionLevel>(), default_value_t)]
    level: PartitionLevel,
    /// Print JSON: every item with its partition and the rule that put it there.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> CommandResult {
    args.command.run()
}

fn change(args: &Change) -> CommandResult {
    let (map, before) = load(&args.scene, PartitionLevel::Room)?;
    let json = read("changes", &args.changes)?;
    let changed = delta::parse_changes(&json).and_then(|changes| map.changed(changes));
    let changed = changed.map_err(|error| in_file("changes", &args.changes, &error))?;
    let after = before.regroup(&changed, &GroundingOptions::default())?;
    write(&args.out, changed.to_json().as_bytes())?;
    print(&format!(
        "{}: {}, {}, {} outside, {} that the map did not have\n",
        args.out.display(),
        count(changed.rooms().len(), "room"),
        count(changed.items().len(), "item"),
        after.grounding.unassigned().len(),
        count(after.new_labels, "label")
    ))
}

fn apply(args: &Apply) -> CommandResult {
    let json = if args.changes.as_os_str() == "-" {
        std::io::read_to_string(std::io::stdin())
            .map_err(|error| input(format!("cannot read standard input: {error}")))?
    } else {
        read("changes", &args.changes)?
    };
    let question = MapQuestion {
        id: service::question_name(),
        expected_map: args.expect.clone(),
        changes: delta::parse_changes(&json).map_err(|error| in_file("changes", &args.changes, &error))?,
    };
    let answer: MapAnswer = args.asking.asker("roomcast-scene", question::MAP_CHANGE)?.ask(&question)?;
    if args.json {
        super::print_json(&answer)?;
    }
    if answer.outcome != Outcome::Applied {
        let reason = answer.reason.as_deref().unwrap_or("no reason given");
        return Err(input(format!("the daemon did not change its map: {reason}")));
    }
    if args.json {
        return Ok(());
    }
    let model = match answer.new_labels {
        0 if answer.prepared_again => "the model was prepared for fewer labels".to_owned(),
        0 => "the model was not touched".to_owned(),
        labels => format!("the model was prepared for {}", count(labels, "new label")),
    };
    let after_restart = if answer.kept {
        ""
    } else {
        "; a restarted daemon begins with its scene file again (daemon.state keeps changes)"
    };
    print(&format!(
        "map {}: {}, {}, {} outside; regrouped in {:.2} ms, {model}{after_restart}\n",
        &answer.map[..answer.map.len().min(16)],
        count(answer.rooms, "room"),
        count(answer.items, "item"),
        answer.outside,
        answer.regrouped_in_ns as f64 / 1e6,
    ))
}

/// Largest distance of a door from the rooms that it joins, in metres: walls have a thickness.
const DOOR_OFF_M: f64 = 0.5;
/// Largest distance of an item's point from its box, in metres: numbers are rounded.
const ITEM_OFF_M: f64 = 0.05;

fn warnings(map: &SemanticMap, grounding: &Grounding) -> Vec<String> {
    let mut warnings = Vec::new();
    for (ItemId(item), Reason::Outside { nearest, distance_m }) in grounding.unassigned() {
        warnings.push(format!(
            "items[{item}] ({:?}) lies outside every room, {distance_m:.2} m from {:?}",
            map.items()[*item as usize].id,
            grounding.partitions()[nearest.0 as usize].id
        ));
    }
    for (index, room) in map.rooms().iter().enumerate() {
        let volume_m3 = room.space.volume_m3();
        if volume_m3 > LARGEST_M3 {
            warnings.push(format!("rooms[{index}] ({:?}) has {volume_m3:.0} m³: lengths are metres", room.id));
        }
    }
    for (index, room) in (0u32..).zip(map.rooms()).skip(1) {
        if map.path(RoomId(0), RoomId(index)).is_none() {
            warnings.push(format!("no way through doors leads from {:?} to {:?}", map.rooms()[0].id, room.id));
        }
    }
    for (index, door) in map.doors().iter().enumerate() {
        for room in door.rooms.map(|RoomId(room)| &map.rooms()[room as usize]) {
            let distance_m = room.space.distance_m(&door.position_m);
            if distance_m > DOOR_OFF_M {
                warnings.push(format!("doors[{index}] ({:?}) lies {distance_m:.2} m from {:?}", door.id, room.id));
            }
        }
    }
    for (index, item) in map.items().iter().enumerate() {
        let distance_m = item.bounds.distance_m(&item.position_m);
        if distance_m > ITEM_OFF_M {
            warnings.push(format!("items[{index}] ({:?}): position_m lies {distance_m:.2} m outside its box", item.id));
        }
    }
    warnings.extend(overlaps(map, grounding));
    warnings.extend(odd_aliases(map));
    for (index, partition) in (0u32..).zip(grounding.partitions()) {
        if !grounding.item_partition().contains(&Some(PartitionId(index))) {
            warnings.push(format!("no item lies in {:?}; only its name can give it a score", partition.id));
        }
    }
    warnings
}

/// No hall is larger, but a room of a map in centimetres is.
const LARGEST_M3: f64 = 1e6;
/// Largest share of a room's volume inside another one without a warning: walls have a thickness.
const OVERLAP_SHARE: f64 = 0.05;
const NAMED_MAX: usize = 5;

/// Rooms that overlap, except a nook that is listed after the room around it.
fn overlaps(map: &SemanticMap, grounding: &Grounding) -> Vec<String> {
    let mut warnings = Vec::new();
    for (index, later) in map.rooms().iter().enumerate() {
        for earlier in &map.rooms()[..index] {
            let shared_m3 = earlier.space.shared_m3(&later.space);
            let (earlier_m3, later_m3) = (earlier.space.volume_m3(), later.space.volume_m3());
            let is_nook = shared_m3 >= (1.0 - OVERLAP_SHARE) * later_m3 && later_m3 < earlier_m3;
            if is_nook || shared_m3 <= OVERLAP_SHARE * earlier_m3.min(later_m3) {
                continue;
            }
            let lies = |space: &Space, index: usize| space.shared_m3(&map.items()[index].bounds.into()) > 0.0;
            let tied = grounding.item_placement().iter().enumerate().filter(|(_, rule)| **rule == Placement::Tie);
            let tied = tied.filter(|(index, _)| lies(&earlier.space, *index) && lies(&later.space, *index));
            let tied: Vec<_> = tied.map(|(index, _)| map.items()[index].id.as_str()).collect();
            let more = tied.len().saturating_sub(NAMED_MAX);
            let named = tied[..tied.len().min(NAMED_MAX)].join(", ");
            let items = match (tied.len(), more) {
                (0, _) => String::new(),
                (_, 0) => format!(" ({named})"),
                _ => format!(" ({named} and {more} more)"),
            };
            warnings.push(format!(
                "{:?} and {:?} share {shared_m3:.1} m³: what lies there is in {:?}, which stands last{items}; correct the outlines, or \
                 write a nook after the room around it",
                earlier.id, later.id, later.id
            ));
        }
    }
    warnings
}

/// Aliases without effect: of no label, or equal to another label or room.
fn odd_aliases(map: &SemanticMap) -> Vec<String> {
    let is_label = |words: &str| map.labels().iter().any(|label| label == words);
    let is_of = |room: &Room, words: &str| room.id == words || room.label == words;
    let is_known = |words: &str| is_label(words) || map.rooms().iter().any(|room| is_of(room, words));
    // An alias that equals its own room's id is fine.
    let is_another = |words: &str, own: &str| {
        let mut rooms = map.rooms().iter();
        words != own && (is_label(words) || rooms.any(|room| is_of(room, words) && !is_of(room, own)))
    };
    let mut warnings = Vec::new();
    for (label, others) in map.aliases() {
        if !is_known(label) {
            let meant = others.iter().find(|words| is_known(words));
            let meant =
                meant.map_or_else(String::new, |words| format!("; {words:?} is one: is it the other way round?"));
            warnings.push(format!("aliases: {label:?} is no label and no room of this map{meant}"));
        } else if let Some(words) = others.iter().find(|words| is_another(words, label)) {
            warnings.push(format!(
                "aliases: {words:?} of {label:?} is another label or room of this map, and means that; remove it"
            ));
        }
    }
    warnings
}

fn check(args: &Check) -> CommandResult {
    let mut reports = Vec::new();
    let mut text = String::new();
    let (mut errors, mut missing, mut warned) = (0, 0, 0);
    for path in &args.scenes {
        let shown = path.display();
        match load(path, PartitionLevel::Room) {
            Err(failure) => {
                errors += 1;
                missing += usize::from(is_missing(path));
                let _ = writeln!(text, "error    {failure}");
                reports.push(json!({"scene": path, "error": failure.to_string()}));
            }
            Ok((map, grounding)) => {
                let warnings = warnings(&map, &grounding);
                warned += warnings.len();
                let ties = grounding.placed_by(Placement::Tie);
                let _ = writeln!(
                    text,
                    "ok       {shown}: {}, {}, {}, {}, {} outside",
                    count(map.rooms().len(), "room"),
                    count(map.items().len(), "item"),
                    count(map.labels().len(), "label"),
                    count(ties, "tie"),
                    grounding.unassigned().len()
                );
                for warning in &warnings {
                    let _ = writeln!(text, "warning  {shown}: {warning}");
                }
                reports.push(json!({
                    "scene": path, "name": map.name(), "fingerprint": hex::encode(map.fingerprint()), "rooms": map.rooms().len(),
                    "items": map.items().len(), "labels": map.labels().len(), "ties": ties,
                    "outside": grounding.unassigned().len(), "warnings": warnings,
                }));
            }
        }
    }
    print(&if args.json { format!("{:#}\n", Value::from(reports)) } else { text })?;
    match (errors, warned) {
        (0, 0) => Ok(()),
        (0, _) if !args.strict => Ok(()),
        _ => Err(Failure::new(
            if missing > 0 { exit_code::INPUT } else { exit_code::CHECK },
            format!("{} with errors, {}", count(errors, "scene"), count(warned, "warning")),
        )),
    }
}

/// Whether a scene is neither a file nor an included one.
pub(super) fn is_missing(scene: &Path) -> bool {
    matches!(setup::load_map(Some(scene)), Err(SetupError::NoScene { .. }))
}

fn show(args: &Show) -> CommandResult {
    let (map, grounding) = load(&args.scene, args.level)?;
    print(&if args.json { format!("{:#}\n", as_json(&map, &grounding, args.level)) } else { tables(&map, &grounding) })
}

fn as_json(map: &SemanticMap, grounding: &Grounding, level: PartitionLevel) -> Value {
    let partition_id = |id: &PartitionId| grounding.partitions()[id.0 as usize].id.as_str();
    let label = |index: usize| map.labels()[map.items()[index].label.0 as usize].as_str();
    let items: Vec<Value> = (map.items().iter().enumerate())
        .map(|(index, item)| {
            json!({
                "id": item.id, "label": label(index), "position_m": item.position_m,
                "partition": grounding.item_partition()[index].as_ref().map(partition_id),
                "placement": grounding.item_placement()[index],
            })
        })
        .collect();
    let partitions: Vec<Value> = (0u32..)
        .zip(grounding.partitions())
        .map(|(index, partition)| {
            let own = grounding.item_partition().iter().filter(|id| **id == Some(PartitionId(index))).count();
            let rooms: Vec<&str> =
                partition.rooms.iter().map(|room| map.rooms()[room.0 as usize].id.as_str()).collect();
            json!({"id": partition.id, "label": partition.label, "rooms": rooms, "items": own})
        })
        .collect();
    let unassigned: Vec<Value> = (grounding.unassigned().iter())
        .map(|(ItemId(item), Reason::Outside { nearest, distance_m })| {
            let item = *item as usize;
            json!({"id": map.items()[item].id, "label": label(item), "nearest": partition_id(nearest), "distance_m": distance_m})
        })
        .collect();
    let placements: HashMap<&str, usize> =
        Placement::VARIANTS.iter().map(|placement| (placement.into(), grounding.placed_by(*placement))).collect();
    let labels: Vec<Value> = (grounding.scored_labels().iter())
        .map(|label| json!({"label": label.text, "items": label.items.len(), "rooms": label.rooms.len()}))
        .collect();
    json!({
        "name": map.name(), "description": map.description(), "source": map.source(), "fingerprint": hex::encode(map.fingerprint()),
        "level": level, "partitions": partitions, "placements": placements, "labels": labels, "items": items,
        "unassigned": unassigned, "warnings": warnings(map, grounding),
    })
}

fn tables(map: &SemanticMap, grounding: &Grounding) -> String {
    let mut text = format!("{}  ({})\n", map.name(), map.short_fingerprint());
    for line in [map.description(), map.source()].into_iter().filter(|line| !line.is_empty()) {
        let _ = writeln!(text, "{}", prose(line));
    }
    let (items, labels) = (count(map.items().len(), "item"), count(map.labels().len(), "label"));
    let _ = writeln!(text, "{items}, {labels}, {}\n", scene_import::doors(map));

    let mut partitions = table(&["partition", "size (m)", "items", "labels", "most frequent"]);
    for number in partitions.column_iter_mut().skip(1).take(3) {
        number.set_cell_alignment(CellAlignment::Right);
    }
    for (index, partition) in (0u32..).zip(grounding.partitions()) {
        let own = Some(PartitionId(index));
        let items = || grounding.item_partition().iter().zip(map.items()).filter(move |(id, _)| **id == own);
        let mut counts: HashMap<usize, usize> = HashMap::new();
        items().for_each(|(_, item)| *counts.entry(item.label.0 as usize).or_default() += 1);
        let mut frequent: Vec<(usize, usize)> = counts.into_iter().collect();
        frequent.sort_by_key(|&(label, count)| (usize::MAX - count, label));
        let sizes: Vec<String> = (partition.spaces.iter())
            .map(|bounds| bounds.size_m().map(|size_m| format!("{size_m:.1}")).join(" x "))
            .collect();
        let named: Vec<String> =
            frequent.iter().take(4).map(|&(label, count)| format!("{} ({count})", map.labels()[label])).collect();
        partitions.add_row([
            partition.id.clone(),
            sizes.join(", "),
            items().count().to_string(),
            frequent.len().to_string(),
            named.join(", "),
        ]);
    }
    let _ = writeln!(text, "{partitions}\n");

    let mut rules = table(&["how items were placed", "items"]);
    let meaning = |placement: &Placement| match placement {
        Placement::Overlap => "largest overlap of volume",
        Placement::Tie => "several equal overlaps: the last of them in the file",
        Placement::Position => "no overlap: by its position",
        Placement::NearestPart => "in no part of its room: the nearest part",
        Placement::Outside => "outside: assigned nowhere, still counted with its label",
    };
    for placement in Placement::VARIANTS {
        let count = grounding.placed_by(*placement);
        if count > 0 {
            rules.add_row([meaning(placement).to_owned(), count.to_string()]);
        }
    }
    let _ = writeln!(text, "{rules}");

    const ROWS: usize = 20;
    for placement in &Placement::VARIANTS[1..] {
        let chosen: Vec<usize> =
            (0..map.items().len()).filter(|&index| grounding.item_placement()[index] == *placement).collect();
        if chosen.is_empty() {
            continue;
        }
        let mut rows = table(&[placement.into(), "label", "went to"]);
        for &index in chosen.iter().take(ROWS) {
            let item = &map.items()[index];
            let went = grounding.item_partition()[index]
                .map_or_else(|| "nowhere".to_owned(), |id| grounding.partitions()[id.0 as usize].id.clone());
            rows.add_row([item.id.clone(), map.labels()[item.label.0 as usize].clone(), went]);
        }
        let _ = writeln!(text, "\n{rows}");
        if chosen.len() > ROWS {
            let _ = writeln!(text, "and {} more; all of them with --json", chosen.len() - ROWS);
        }
    }
    for warning in warnings(map, grounding) {
        let _ = writeln!(text, "{}", prose(&format!("warning  {warning}")));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::semantic_map::import::{self, Registries};

    fn warned(rooms: &Value, items: &Value, aliases: &Value) -> Vec<String> {
        let scene = json!({
            "format": "roomcast-scene", "version": 1, "name": "home", "rooms": rooms, "items": items, "aliases": aliases,
        });
        let map = SemanticMap::from_json(&scene.to_string()).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        [overlaps(&map, &grounding), odd_aliases(&map)].concat()
    }

    fn room(id: &str, west: f64, east: f64) -> Value {
        json!({"id": id, "label": id, "box": {"min_m": [west, 0, 0], "max_m": [east, 4, 2.5]}})
    }

    fn item(label: &str, x: f64) -> Value {
        let bounds = json!({"min_m": [x, 1, 0], "max_m": [x + 0.5, 1.5, 1]});
        json!({"id": format!("{label}-1"), "label": label, "position_m": [x, 1, 1], "box": bounds})
    }

    #[test]
    fn rooms_that_overlap_by_mistake_are_told_of() {
        let items = json!([item("fridge", 1.0), item("sofa", 6.0)]);
        let of = |rooms: &[Value]| warned(&json!(rooms), &items, &json!({}));
        let (kitchen, living) = (room("kitchen", 0.0, 3.0), room("living", 0.0, 8.0));
        // With a wrong corner, the room contains everything in the other one.
        let said = of(&[kitchen.clone(), living.clone()]);
        assert_eq!(said.len(), 1);
        assert!(
            said[0].starts_with("\"kitchen\" and \"living\" share 30.0 m³: what lies there is in \"living\""),
            "{said:?}"
        );
        assert!(said[0].contains("(fridge-1)"), "{said:?}");
        assert_eq!(of(&[living, kitchen.clone()]), [""; 0], "a nook is written after the room around it");
        let partly = of(&[room("living", 2.0, 8.0), kitchen.clone()]);
        assert!(
            partly.len() == 1 && partly[0].contains("share 10.0 m³") && !partly[0].contains("fridge"),
            "{partly:?}"
        );
        assert_eq!(of(&[room("living", 2.9, 8.0), kitchen]), [""; 0], "a wall");
    }

    #[test]
    fn a_map_in_centimetres_is_told_of() {
        let large = json!({"id": "hall", "label": "hall", "box": {"min_m": [0, 0, 0], "max_m": [400, 400, 250]}});
        let scene = json!({"format": "roomcast-scene", "version": 1, "name": "home", "rooms": [large], "items": [item("sofa", 1.0)]});
        let map = SemanticMap::from_json(&scene.to_string()).unwrap();
        let warned = warnings(&map, &Grounding::new(&map, &GroundingOptions::default()).unwrap());
        assert!(warned.len() == 1 && warned[0].contains("lengths are metres"), "{warned:?}");
    }

    #[test]
    fn aliases_that_mean_nothing_are_told_of() {
        let of = |aliases: Value| {
            let items = json!([item("sofa", 1.0), item("television", 2.0)]);
            warned(&json!([room("kitchen", 0.0, 3.0)]), &items, &aliases)
        };
        assert_eq!(of(json!({"sofa": ["couch"], "kitchen": ["galley"]})), [""; 0]);
        let reversed = of(json!({"couch": ["sofa"]}));
        assert_eq!(
            reversed,
            ["aliases: \"couch\" is no label and no room of this map; \"sofa\" is one: is it the other way round?"]
        );
        assert_eq!(of(json!({"couch": ["settee"]})), ["aliases: \"couch\" is no label and no room of this map"]);
        let label = of(json!({"sofa": ["television"]}));
        assert!(label.len() == 1 && label[0].contains("\"television\" of \"sofa\" is another label"), "{label:?}");
        let rooms = |aliases: Value| {
            let mut rooms = [room("wohnzimmer", 0.0, 3.0), room("wz", 3.0, 6.0)];
            (rooms[0]["label"], rooms[1]["label"]) = ("living room".into(), "lounge".into());
            warned(&json!(rooms), &json!([item("sofa", 1.0)]), &aliases)
        };
        for own in ["living room", "wohnzimmer"] {
            assert_eq!(rooms(json!({own: ["wohnzimmer", "living room"]})), [""; 0], "the room's own names");
            let other = rooms(json!({own: ["wohnzimmer", "wz"]}));
            assert!(other.len() == 1 && other[0].contains(&format!("\"wz\" of {own:?}")), "{other:?}");
        }
    }

    /// The import writes no odd aliases.
    #[test]
    fn the_map_of_a_home_assistant_has_no_odd_aliases() {
        let area = |(id, name): (&str, &str)| json!({"id": id, "name": name, "aliases": ["Stube", "wz"]});
        let names = [
            ("wohnzimmer", "Wohnzimmer"),
            ("kuche", "Küche"),
            ("kinderzimmer_tom", "Kinderzimmer Tom"),
            ("flur", "Flur"),
        ];
        let areas = json!({"data": {"areas": names.map(area)}}).to_string();
        let registries = Registries { areas: &areas, ..Default::default() };
        let map = import::home_assistant(&registries, "home")
            .unwrap()
            .imported
            .furnish(import::Furnish::Typical)
            .unwrap()
            .map;
        assert_eq!(odd_aliases(&map), [""; 0], "{:?}", map.aliases());
        for (place, (id, name)) in (0..).zip(names) {
            assert_eq!([map.find_room(id), map.find_room(name)], [Some(RoomId(place)); 2], "{name}");
        }
        assert!(
            !map.aliases().values().flatten().any(|words| words == "flur"),
            "an id needs no alias: {:?}",
            map.aliases()
        );
    }
}
