//! `roomcast scene draw`: a scene from above, with scores as heat.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use roomcast_core::grounding::{Grounding, PartitionLevel};
use roomcast_core::parsing::json_says;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_simulation::drawing::{self, Heat};

use super::choice::choice;
use super::scene_files::{input, load, read, write};
use super::{CommandResult, Failure, print};

#[derive(Debug, clap::Args)]
pub struct Args {
    /// The scene file, or the name of an included one.
    scene: PathBuf,
    /// The drawing; the ending, `.svg` or `.png`, selects the format; PNG needs a build with the feature `png`. By default the scene's name with
    /// `.svg`, in this folder.
    #[arg(long)]
    out: Option<PathBuf>,
    /// The level of a partition.
    #[arg(long, value_parser = choice::<PartitionLevel>(), default_value_t)]
    level: PartitionLevel,
    /// The output of `roomcast score --json` for this scene and level.
    #[arg(long, value_name = "FILE")]
    scores: Option<PathBuf>,
    /// A line under the title of scores; by default the map's figures.
    #[arg(long, requires = "scores")]
    caption: Option<String>,
    /// Pixels of the PNG per pixel of the SVG.
    #[arg(long, default_value_t = 2.0, value_parser = parse_scale)]
    scale: f32,
}

fn parse_scale(text: &str) -> Result<f32, String> {
    let scale = text.parse().ok().filter(|scale| (0.1..=8.0).contains(scale));
    scale.ok_or_else(|| "give a number from 0.1 to 8".to_owned())
}

/// The part of `roomcast score --json` that a drawing needs.
#[derive(serde::Deserialize)]
struct Scores {
    partitions: Vec<PartitionScore>,
    items: Vec<ItemScore>,
}

#[derive(serde::Deserialize)]
struct PartitionScore {
    id: String,
    probability: f64,
}

#[derive(serde::Deserialize)]
struct ItemScore {
    id: String,
    /// JSON has no minus infinity: null.
    log_score_nats: Option<f64>,
}

fn read_heat(path: &Path, map: &SemanticMap, grounding: &Grounding, caption: &str) -> Result<Heat, Failure> {
    let shown = path.display();
    let wrong = |problem: String| {
        input(format!("scores {shown}: {problem}; give what `roomcast score --json` printed for this scene and level"))
    };
    let json = read("scores", path)?;
    let scores: Scores = serde_json::from_str(&json).map_err(|error| wrong(json_says(&error)))?;
    let partitions: HashMap<&str, f64> =
        scores.partitions.iter().map(|score| (score.id.as_str(), score.probability)).collect();
    let items: HashMap<&str, f64> = (scores.items.iter())
        .map(|score| (score.id.as_str(), score.log_score_nats.unwrap_or(f64::NEG_INFINITY)))
        .collect();
    let partition =
        |id: &String| partitions.get(id.as_str()).copied().ok_or_else(|| wrong(format!("no partition {id:?}")));
    let item = |id: &String| items.get(id.as_str()).copied().ok_or_else(|| wrong(format!("no item {id:?}")));
    let probabilities: Vec<f64> =
        grounding.partitions().iter().map(|own| partition(&own.id)).collect::<Result<_, _>>()?;
    let log_scores: Vec<f64> = map.items().iter().map(|own| item(&own.id)).collect::<Result<_, _>>()?;
    Ok(Heat::new(&probabilities, &log_scores, caption))
}

pub fn run(args: &Args) -> CommandResult {
    let (map, grounding) = load(&args.scene, args.level)?;
    let caption = args.caption.as_deref().unwrap_or_default();
    let heat = args.scores.as_deref().map(|path| read_heat(path, &map, &grounding, caption)).transpose()?;
    let stem = args.scene.file_stem().map(PathBuf::from).unwrap_or_else(|| PathBuf::from("scene"));
    let out = args.out.clone().unwrap_or_else(|| stem.with_extension("svg"));
    let svg = drawing::svg(&map, &grounding, heat.as_ref()).map_err(input)?;
    write_drawing(&out, svg, args.scale)?;
    print(&format!("{}\n", out.display()))
}

#[cfg(feature = "png")]
fn png(svg: &str, scale: f32) -> Result<Vec<u8>, Failure> {
    roomcast_simulation::png::png(svg, scale).map_err(Failure::failed)
}

#[cfg(not(feature = "png"))]
fn png(_svg: &str, _scale: f32) -> Result<Vec<u8>, Failure> {
    let remedy = "this build draws no PNG: give a name that ends in .svg, which every browser shows, or build with --features png";
    Err(Failure::usage(remedy))
}

pub(super) fn write_drawing(path: &Path, svg: String, scale: f32) -> CommandResult {
    let bytes = match path.extension().and_then(|ending| ending.to_str()) {
        Some("svg") => svg.into_bytes(),
        Some("png") => png(&svg, scale)?,
        _ => {
            let shown = path.display();
            return Err(Failure::usage(format!("{shown} ends neither in .svg nor in .png; rename it")));
        }
    };
    write(path, &bytes)
}
