//! `roomcast scene import`: turns maps of other formats into scenes.

use std::collections::HashMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use serde_json::Value;

use super::choice::choice;
use super::home_source::{HomeOptions, home_assistant, is_url, write_rules};
use super::scene_files::{in_file, in_map, input, read, segment_names, write};
use super::{CommandResult, Failure, count, print};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::semantic_map::import::{self, Furnish, Home, Imported, Registries, Up};

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// A VirtualHome environment graph.
    Virtualhome,
    /// Objects with captions and boxes, rooms with boxes or polygons, as ConceptGraphs and HOV-SG export them.
    OpenVocabulary,
    /// A vacuum robot's map, as Valetudo exports it: segments become rooms.
    Valetudo,
    /// A Home Assistant, by its configuration folder or its address: areas become rooms, entities things; a rules file comes with the map.
    HomeAssistant,
}

#[derive(Debug, clap::Args)]
pub struct Args {
    /// The map: a file, a folder, or an address.
    ///
    /// For an open-vocabulary map, several files that belong together, or a folder of them. For a Home Assistant, its configuration folder, or its
    /// address (http://HOST:8123) with --token-file.
    #[arg(required = true)]
    graph: Vec<PathBuf>,
    /// The scene to write.
    #[arg(long)]
    out: PathBuf,
    /// The format of the map; by default detected from the file.
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// The scene's name; by default the map file's name.
    #[arg(long)]
    name: Option<String>,
    /// VirtualHome's table of equivalent class names; adds aliases.
    #[arg(long, value_name = "FILE")]
    equivalence: Option<PathBuf>,
    /// The axis of an open-vocabulary map that points up, if the map does not say.
    #[arg(long, value_parser = choice::<Up>(), default_value_t)]
    up: Up,
    /// Keep labels of an open-vocabulary map that differ only in spelling or number ("mugs", "coffeemaker").
    #[arg(long)]
    keep_spellings: bool,
    /// Names for the segments of a Valetudo map: a TOML file with a line such as `11 = "kitchen"` each.
    #[arg(long, value_name = "FILE")]
    names: Option<PathBuf>,
    /// The file for the rules from a Home Assistant's map; by default next to the map, as `NAME.rules.toml`. An existing file stays.
    #[arg(long, value_name = "FILE")]
    rules: Option<PathBuf>,
    /// An area of Home Assistant that becomes no room, by its name or id; once for each.
    #[arg(long, value_name = "AREA")]
    leave_out: Vec<String>,
    /// A file with a long-lived access token of the Home Assistant at an address; only its owner may be able to read it.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// A PEM file with the certificates of the Home Assistant's certificate authority, for an https address.
    #[arg(long, value_name = "FILE", requires = "token_file")]
    ca: Option<PathBuf>,
    /// Put the usual furniture of their kind into rooms; ids of such things begin with "assumed".
    #[arg(long, value_parser = choice::<Furnish>())]
    furnish: Option<Furnish>,
}

impl Args {
    /// Refuses options that the format does not use: they would be ignored silently.
    fn refuse_without_effect(&self, format: Format) -> CommandResult {
        let options = [
            (self.equivalence.is_some(), "--equivalence", "has VirtualHome's names", Format::Virtualhome),
            (self.up != Up::default(), "--up", "is of an open-vocabulary map", Format::OpenVocabulary),
            (self.keep_spellings, "--keep-spellings", "is of an open-vocabulary map", Format::OpenVocabulary),
            (self.names.is_some(), "--names", "names the segments of a Valetudo map", Format::Valetudo),
            (self.rules.is_some(), "--rules", "come with a Home Assistant's map", Format::HomeAssistant),
            (!self.leave_out.is_empty(), "--leave-out", "names an area of Home Assistant", Format::HomeAssistant),
            (self.token_file.is_some(), "--token-file", "is for a Home Assistant's address", Format::HomeAssistant),
        ];
        let Some((_, option, why, of)) = options.iter().find(|(given, .., of)| *given && *of != format) else {
            return Ok(());
        };
        let of = of.to_possible_value();
        let of = of.as_ref().map_or("", |value| value.get_name());
        Err(Failure::usage(format!("{option} {why}; give --format {of}, or leave it out")))
    }
}

impl Format {
    /// The format of the map at `first`, by its files and keys.
    fn detect(first: &Path, is_alone: bool) -> Result<Self, Failure> {
        if is_url(first) {
            return Ok(Self::HomeAssistant);
        }
        if first.is_dir() {
            let is_home = [".storage", "core.area_registry"].iter().any(|name| first.join(name).exists());
            return Ok(if is_home { Self::HomeAssistant } else { Self::OpenVocabulary });
        }
        if !is_alone {
            return Ok(Self::OpenVocabulary);
        }
        Self::of_text(&read("map", first)?).map_err(|why| input(format!("map {}: {why}", first.display())))
    }

    fn of_text(text: &str) -> Result<Self, &'static str> {
        let text = text.trim_start_matches('\u{feff}');
        let map: Value = serde_json::from_str(text).map_err(|_| "it is no JSON; give a map, or its --format")?;
        let has = |keys: &[&str]| keys.iter().any(|key| map.get(key).is_some());
        if map.get("format").is_some_and(|format| format == "roomcast-scene") {
            return Err("it is a scene already; give it to --scene as it is");
        }
        if has(&["layers", "pixelSize"]) {
            return Ok(Self::Valetudo);
        }
        if has(&["nodes"]) {
            return Ok(Self::Virtualhome);
        }
        if map.is_array() || has(&["objects", "rooms", "object_id", "room_id"]) {
            return Ok(Self::OpenVocabulary);
        }
        Err(
            "its format is unknown; a Valetudo map has the key `layers`, a VirtualHome graph `nodes`, an open-vocabulary map `objects`; or give --format",
        )
    }
}

/// A map, and the rules that came with it, with their file.
type Source = (Imported, Option<(PathBuf, String)>);

impl Args {
    fn only(&self, what: &str) -> Result<&Path, Failure> {
        match &self.graph[..] {
            [only] => Ok(only),
            _ => Err(Failure::usage(format!("{what}; give exactly one"))),
        }
    }

    fn source(&self, format: Format) -> Result<Source, Failure> {
        let stem = self.graph[0].file_stem().map(|stem| stem.to_string_lossy().into_owned());
        let name = self.name.clone().or(stem).unwrap_or_else(|| "imported".to_owned());
        let in_first = |error| in_file("map", &self.graph[0], &error);
        let imported = match format {
            Format::Virtualhome => {
                let graph = self.only("a VirtualHome graph is one file")?;
                let equivalence = self.equivalence.as_deref().map(|path| read("table of names", path)).transpose()?;
                import::virtualhome(&read("map", graph)?, &name, equivalence.as_deref()).map_err(in_first)?
            }
            Format::OpenVocabulary => {
                let mut texts = Vec::new();
                for path in map_files(&self.graph)? {
                    texts.push(read("map", &path)?);
                }
                let json = import::combine(texts.iter().map(String::as_str)).map_err(in_first)?;
                let imported = import::open_vocabulary(&json, &name, self.up).map_err(in_first)?;
                if self.keep_spellings { imported } else { imported.merge_spellings().map_err(in_first)? }
            }
            Format::Valetudo => {
                let graph = self.only("a Valetudo map is one file")?;
                let names = self.names.as_deref().map(segment_names).transpose()?.unwrap_or_else(HashMap::new);
                import::valetudo(&read("map", graph)?, &name, &names)
                    .map_err(|error| in_map(graph, self.names.as_deref(), &error))?
            }
            Format::HomeAssistant => return self.home(),
        };
        Ok((imported, None))
    }

    fn home(&self) -> Result<Source, Failure> {
        let folder = self.only("a Home Assistant is one configuration folder or one address")?;
        let name = self.name.as_deref().unwrap_or("home");
        let registries =
            Registries { leave_out: &self.leave_out, furnished: self.furnish.is_some(), ..Registries::default() };
        let (token_file, authority) = (self.token_file.as_deref(), self.ca.as_deref());
        let Home { imported, rules, .. } =
            home_assistant(folder, name, HomeOptions { token_file, authority, registries })?;
        let path = || self.rules.clone().unwrap_or_else(|| self.out.with_extension("rules.toml"));
        Ok((imported, rules.map(|text| (path(), text))))
    }
}

pub fn run(args: &Args) -> CommandResult {
    let format = match args.format {
        Some(format) => format,
        None => Format::detect(&args.graph[0], args.graph.len() == 1)?,
    };
    args.refuse_without_effect(format)?;
    let (imported, rules) = args.source(format)?;
    let imported = match args.furnish {
        Some(furnish) => imported.furnish(furnish).map_err(|error| in_file("map", &args.graph[0], &error))?,
        None => imported,
    };
    let Imported { map, notes, boxed } = imported;
    if !boxed.is_empty() {
        let rooms: Vec<_> = boxed.iter().map(|room| format!("{room:?}")).collect();
        super::tell(format_args!(
            "roomcast: the polygon meets itself or has no area: {}; each of these rooms is the box around its polygon now; look at them with \
             `roomcast scene draw`",
            rooms.join(", ")
        ));
    }
    write(&args.out, map.to_json().as_bytes())?;
    let mut text = format!(
        "{}: {}, {}, {}, {}\n",
        args.out.display(),
        count(map.rooms().len(), "room"),
        doors(&map),
        count(map.items().len(), "item"),
        count(map.labels().len(), "label")
    );
    for note in notes {
        let _ = writeln!(text, "  {note}");
    }
    if let Some((path, rules)) = rules {
        let _ = writeln!(text, "{}", write_rules(&path, &rules)?);
    }
    print(&text)
}

/// "3 doors", and whether they were found where rooms touch.
pub(super) fn doors(map: &SemanticMap) -> String {
    let found = if map.doors_found() && !map.doors().is_empty() { " found where rooms touch" } else { "" };
    format!("{}{found}", count(map.doors().len(), "door"))
}

/// The files, sorted by name, with folders replaced by the JSON files in them and in their subfolders.
fn map_files(paths: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    const DEEPEST: usize = 3;
    fn collect(path: &Path, depth: usize, files: &mut Vec<PathBuf>) -> std::io::Result<()> {
        if !path.is_dir() {
            files.push(path.to_owned());
            return Ok(());
        }
        let mut entries: Vec<PathBuf> =
            std::fs::read_dir(path)?.map(|entry| entry.map(|entry| entry.path())).collect::<Result<_, _>>()?;
        entries.sort();
        for entry in entries {
            let json = entry.extension().is_some_and(|ending| ending == "json");
            if json || (depth < DEEPEST && entry.is_dir()) {
                collect(&entry, depth + 1, files)?;
            }
        }
        Ok(())
    }
    let mut files = Vec::new();
    for path in paths {
        collect(path, 0, &mut files).map_err(|error| {
            input(format!("cannot read the folder {}: {error}; check its permissions", path.display()))
        })?;
    }
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exit_code;

    #[test]
    fn the_keys_of_a_map_show_its_format() {
        let of = |text: &str| Format::of_text(text);
        assert_eq!(of(include_str!("../../tests/data/valetudo.json")), Ok(Format::Valetudo));
        assert_eq!(of(r#"{"nodes": [], "edges": []}"#), Ok(Format::Virtualhome));
        for text in [r#"{"objects": []}"#, "\u{feff}[]", r#"{"object_id": "0_0_1", "vertices": []}"#] {
            assert_eq!(of(text), Ok(Format::OpenVocabulary), "{text}");
        }
        for (text, fault) in [
            (include_str!("../../scenes/studio.json"), "is a scene already"),
            ("{}", "format is unknown"),
            ("rooms:", "no JSON"),
        ] {
            assert!(of(text).is_err_and(|why| why.contains(fault)), "{fault}");
        }
    }

    #[test]
    fn a_folder_with_registries_is_a_home_assistant_and_another_one_a_set_of_objects() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(Format::detect(folder.path(), true).unwrap(), Format::OpenVocabulary);
        std::fs::create_dir(folder.path().join(".storage")).unwrap();
        assert_eq!(Format::detect(folder.path(), true).unwrap(), Format::HomeAssistant);
        assert_eq!(Format::detect("http://homeassistant:8123".as_ref(), true).unwrap(), Format::HomeAssistant);
        let missing = Format::detect("/nowhere/map.json".as_ref(), true).unwrap_err();
        assert_eq!(missing.code, exit_code::INPUT);
    }
}
