//! Runs the commands that the manual shows, in a prepared folder next to a running daemon and planner, and compares the output that it shows.
//! Numbers and bars are not compared, because they depend on the machine.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use roomcast_ipc::raw::RoomScoresV1;

use crate::eventually::eventually;
use crate::world::{World, roomcast};

/// Commands that this test only counts, by their beginning, with the reason.
const LEFT_OUT: &[(&str, &str)] = &[
    ("COMMAND", "a placeholder"),
    ("config > roomcast.toml", "the folder has the file"),
    ("daemon", "runs already"),
    ("demo", "tests of the demo"),
    ("doctor --config", "needs a broker"),
    ("explain --recording day.mcap --sequence", "needs a long recording"),
    ("init", "needs a broker; tests of the set-up"),
    ("latency", "tests of the latency"),
    ("man DIR", "a placeholder"),
    ("model check FILE", "a placeholder"),
    ("model info FILE", "a placeholder"),
    ("model pull", "needs the internet"),
    ("narrate --mqtt", "needs a broker"),
    ("narrate --sensors day.csv --rules rules.toml --speed", "takes 24 minutes"),
    ("planner", "runs already"),
    ("publish", "needs a broker"),
    ("record", "runs until a signal; tests of recordings"),
    ("replay", "needs a fresh daemon; tests of recordings"),
    ("robot", "needs a broker"),
    ("scene apply", "needs another map; tests of the map"),
    ("scene change", "needs a file of changes; tests of the map"),
    ("view", "runs until a signal; tests of the browser"),
];

/// Pages with the output of another home, with sensors, a broker or a robot.
const OTHER_HOMES: &[&str] =
    &["docs/where.md", "docs/recording.md", "docs/troubleshooting.md", "docs/publish.md", "docs/robot.md"];

/// A block of commands, with the output that follows it.
struct Shown {
    commands: Vec<String>,
    output: Option<String>,
}

fn shown(page: &str) -> Vec<Shown> {
    let mut blocks = Vec::new();
    let mut parts = page.split("\n```").skip(1);
    // Fences come in pairs: the text between an opening and a closing one is a block.
    while let (Some(block), between) = (parts.next(), parts.next()) {
        let (kind, text) = block.split_once('\n').unwrap_or((block, ""));
        let is_next = !between.unwrap_or_default().contains("\n#");
        blocks.push((kind.to_owned(), text.to_owned(), is_next));
    }
    let mut all = Vec::new();
    for (at, (kind, text, is_next)) in blocks.iter().enumerate() {
        if kind == "sh" {
            let output = blocks.get(at + 1).filter(|next| *is_next && next.0 == "text").map(|next| next.1.clone());
            all.push(Shown { commands: commands(text), output });
        }
    }
    all
}

/// The lines that run `roomcast`, without comments.
fn commands(block: &str) -> Vec<String> {
    let lines = block.replace("\\\n", " ");
    let lines = lines.lines().map(|line| line.split(" #").next().unwrap_or_default().trim());
    let lines = lines.map(|line| line.strip_prefix("target/release/").unwrap_or(line));
    lines.filter(|line| line.starts_with("roomcast ") || line.contains("| roomcast ")).map(str::to_owned).collect()
}

/// A line without the parts that depend on the machine: digits, bars, widths of columns, and the processor's extensions (`AVX512_VNNI`).
fn masked(line: &str) -> String {
    // On a busy machine `doctor` may find another cache faster.
    let line = line.split("; with model.cache").next().unwrap_or_default();
    let mut text = String::new();
    for char in line.chars().filter(|char| !('▀'..='▟').contains(char)) {
        match char {
            '0'..='9' if text.ends_with('0') => {}
            '0'..='9' => text.push('0'),
            _ => text.push(char),
        }
    }
    let is_extension = |word: &&str| {
        let letters = word.trim_end_matches(',');
        letters.len() >= 3 && letters.bytes().all(|byte| matches!(byte, b'A'..=b'Z' | b'0' | b'_'))
    };
    text.replace("0.0", "0").split_whitespace().filter(|word| !is_extension(word)).collect::<Vec<_>>().join(" ")
}

/// The files that the pages name.
fn prepare(folder: &Path, page: &str, text: &str) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let studio = fs::read_to_string(root.join("scenes/studio.json")).unwrap();
    let own = text.split("```json\n").skip(1).map(|rest| rest.split("```").next().unwrap_or_default());
    let own = own.filter(|block| block.contains("roomcast-scene")).last();
    fs::create_dir_all(folder.join("home")).unwrap();
    // `habits export` makes a file of this name.
    if page != "docs/habits.md" {
        fs::write(folder.join("home.json"), own.unwrap_or(&studio)).unwrap();
    }
    fs::write(folder.join("home/home.json"), &studio).unwrap();
    fs::write(folder.join("home/home.rules.toml"), "[[rule]]\ntopic = \"a\"\nsay = \"They sit.\"\n").unwrap();
    let config = "[scene]\npath = \"home.json\"\n[mqtt]\nbroker = \"mqtt://127.0.0.1\"\nrules = \"home.rules.toml\"\n";
    fs::write(folder.join("home/roomcast.toml"), config).unwrap();
    fs::write(folder.join("roomcast.toml"), "").unwrap();
    for (from, to) in [("sensors.tsv", "day.csv"), ("sensor-rules.toml", "rules.toml")] {
        fs::copy(root.join("tests/data").join(from), folder.join(to)).unwrap();
    }
}

#[test]
fn the_commands_of_the_manual_run_and_print_what_it_shows() {
    let mut world = World::new("manual");
    world.start_daemon();
    world.start(&["planner"]);
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    eventually("the first scores", || scores.newest().unwrap());
    let day = world.path("day.mcap");
    let record = world.start(&["record", day.to_str().unwrap()]);
    eventually("the recording begins", || day.exists().then_some(()));

    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut pages = vec!["README.md".to_owned(), "scenes/README.md".to_owned()];
    let docs =
        fs::read_dir(root.join("docs")).unwrap().filter_map(|entry| entry.unwrap().file_name().into_string().ok());
    pages.extend(docs.filter(|name| name.ends_with(".md")).map(|name| format!("docs/{name}")));
    // The first page has one person, and the page on persons names a third one.
    const FIRST: [&str; 2] = ["docs/first-steps.md", "docs/persons.md"];
    pages.sort_by_key(|page| (FIRST.iter().position(|first| first == page).unwrap_or(FIRST.len()), page.clone()));
    let event = |person: &str| format!("{{\"person\": {person}, \"text\": \"They open the fridge.\"}}\n");
    let program = roomcast(&[]).get_program().to_owned();
    let path = format!("{}:/usr/bin:/bin", Path::new(&program).parent().unwrap().display());
    let (mut faults, mut ran, mut compared) = (String::new(), 0, 0);
    for page in pages {
        let text = fs::read_to_string(root.join(&page)).unwrap();
        let folder = world.path(&page.replace('/', "-"));
        fs::create_dir_all(&folder).unwrap();
        prepare(&folder, &page, &text);
        let persons: &[&str] = match page.as_str() {
            "docs/first-steps.md" => &[],
            "docs/persons.md" => &["3"],
            _ => &["\"Jon\"", "\"ada\""],
        };
        if !persons.is_empty() {
            world.narrate(&page.replace('/', "-"), &persons.iter().copied().map(event).collect::<String>());
        }
        if page == "docs/persons.md" {
            world.end(record, rustix::process::Signal::TERM);
        }
        fs::copy(&day, folder.join("day.mcap")).unwrap();
        for Shown { commands, output } in shown(&page_text(&text)) {
            let mut printed = String::new();
            let mut is_whole = true;
            for line in commands {
                let own = line.split_once("roomcast ").map_or("", |(_, own)| own);
                if LEFT_OUT.iter().any(|(beginning, _)| own.starts_with(beginning)) {
                    is_whole = false;
                    continue;
                }
                let mut command = Command::new("/bin/sh");
                command.args(["-c", &line]).current_dir(&folder).env("PATH", &path).env_remove("ROOMCAST_CONFIG");
                command.env("ROOMCAST_ROOT", world.domain.root()).env("ROOMCAST_DOMAIN", world.domain.name());
                let output = command.stdin(Stdio::null()).output().unwrap();
                printed += &String::from_utf8_lossy(&output.stdout);
                ran += 1;
                if !output.status.success() {
                    let said = String::from_utf8_lossy(&output.stderr);
                    let _ = writeln!(faults, "{page}: {line}: {}: {said}", output.status);
                }
            }
            let Some(output) = output.filter(|_| is_whole && !OTHER_HOMES.contains(&page.as_str())) else { continue };
            compared += 1;
            let printed: Vec<String> = printed.lines().map(masked).collect();
            for line in output.lines().map(masked).filter(|line| !line.is_empty() && line != "...") {
                if !printed.contains(&line) {
                    let _ = writeln!(faults, "{page}: {line:?} is not printed now:\n{}", printed.join("\n"));
                }
            }
        }
    }
    assert!(faults.is_empty(), "{faults}");
    assert!(ran >= 25 && compared >= 5, "{ran} commands ran, {compared} outputs were compared");
}

/// Lists indent their blocks.
fn page_text(page: &str) -> String {
    page.lines()
        .map(|line| if line.trim_start().starts_with("```") { line.trim_start() } else { line })
        .fold(String::new(), |text, line| text + line + "\n")
}
