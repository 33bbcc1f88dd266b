use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use roomcast_ipc::raw::RoomScoresV1;
use roomcast_services::embedded::MODEL;
use rustix::process::{Pid, Signal, kill_process};

use super::{World, eventually, exit_code, roomcast, scores_with};

/// `timeout` and terminals signal the process and then its group.
#[test]
fn signals_in_a_row_are_one_wish_to_stop() {
    let mut world = World::new("twice");
    let daemon = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    scores_with(&node.subscriber::<RoomScoresV1>().unwrap(), "the first scores", |_| true);
    for signal in [Signal::TERM, Signal::INT, Signal::TERM] {
        world.signal(daemon, signal);
    }
    let (status, log) = world.wait(daemon);
    assert!(status.success() && log.contains("stopped"), "{status}: {log}");
    drop(node);
    assert!(world.domain.clean_up().unwrap());
    assert_eq!(world.shared_memory_files(), Vec::<String>::new());
}

/// A `const` would be copied into each codegen unit that uses it.
#[test]
fn the_built_program_has_one_copy_of_the_model() {
    let program = std::fs::read(roomcast(&[]).get_program()).unwrap();
    for tenth in [1, 5, 9] {
        let part = &MODEL[MODEL.len() * tenth / 10..][..64];
        let copies = program.windows(part.len()).filter(|bytes| bytes == &part).count();
        assert_eq!(copies, 1, "at {tenth} tenths of the model");
    }
}

#[test]
fn a_wrong_set_up_of_narrate_is_its_end() {
    let world = World::new("wrong");
    let rules = world.directory.path().join("rules.toml");
    std::fs::write(&rules, "[[rule]]\ntopic = \"a\"\nsay = \"They sit.\"").unwrap();
    let (rules, nowhere) = (rules.to_str().unwrap(), "/nowhere/at-all");
    let mqtt = |arguments: &[&'static str]| [&["--rules", rules, "--mqtt"], arguments].concat();
    for (arguments, code, part) in [
        (mqtt(&["http://127.0.0.1:1"]), exit_code::USAGE, "no broker"),
        (mqtt(&["mqtt://h:99999"]), exit_code::USAGE, "no broker"),
        (mqtt(&["mqtts://127.0.0.1:1"]), exit_code::USAGE, "without a CA file"),
        (mqtt(&["mqtt://127.0.0.1:1", "--mqtt-ca", nowhere]), exit_code::USAGE, "with a CA file"),
        (mqtt(&["mqtts://127.0.0.1:1", "--mqtt-ca", nowhere]), exit_code::INPUT, nowhere),
        (mqtt(&["mqtt://127.0.0.1:1", "--mqtt-credentials", nowhere]), exit_code::INPUT, nowhere),
        (vec!["--fifo", rules], exit_code::INPUT, "no named pipe"),
        (vec!["--linger", "nan"], exit_code::USAGE, "a number from 0"),
        (vec!["--linger=-1"], exit_code::USAGE, "a number from 0"),
        (vec!["--name", ""], exit_code::CONFIG, "narrator.name"),
    ] {
        let output = world.command(&["narrate"]).args(&arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(code)), "{arguments:?}: {said}");
        assert!(said.contains(part), "{arguments:?}: {said}");
    }
}

/// A wrong address is a configuration error if the file has it, and a usage error if the command line has it.
#[test]
fn a_broker_that_is_none_is_the_fault_of_who_names_it() {
    let world = World::new("broker");
    let config = world.directory.path().join("roomcast.toml");
    for (address, part) in [("http://h", "no broker"), ("mqtt://ada:secret@h", "user name"), ("mqtts://h", "CA file")] {
        std::fs::write(&config, format!("[mqtt]\nbroker = {address:?}\nrules = \"rules.toml\"\n")).unwrap();
        for command in [&["narrate"][..], &["publish", "mqtt"], &["robot"]] {
            // A narrator uses the configured broker only with `--mqtt`.
            let asked = if command == ["narrate"] { &["--mqtt"][..] } else { &[] };
            let configured = [asked, &["--config", config.to_str().unwrap()]].concat();
            let given = vec!["--mqtt", address];
            for (more, code) in [(configured, exit_code::CONFIG), (given, exit_code::USAGE)] {
                let output = world.command(command).args(&more).output().unwrap();
                let said = String::from_utf8(output.stderr).unwrap();
                assert_eq!(output.status.code(), Some(i32::from(code)), "{command:?} {more:?}: {said}");
                assert!(said.contains(part) && !said.contains("secret"), "{command:?} {more:?}: {said}");
            }
        }
    }
}

/// A service that runs until a signal exits with success, even after bad lines. Work with an end is interrupted.
#[test]
fn a_signal_ends_a_service_well_and_interrupts_work_that_has_an_end() {
    let mut world = World::new("stopped");
    let path = |world: &World, name: &str| world.directory.path().join(name).to_str().unwrap().to_owned();
    let (fifo, lines) = (path(&world, "fifo"), path(&world, "lines"));
    std::fs::write(&lines, "They sit.\n{\"no\": \"narration\"}\nThey stand up.\n").unwrap();
    // No daemon and no planner runs, so no message is confirmed, and every command waits.
    let until = |world: &World, process: usize, word: &str| {
        let log = world.children[process].log.clone();
        eventually(word, || std::fs::read_to_string(&log).ok().filter(|log| log.contains(word)));
    };
    for (number, signal) in [Signal::INT, Signal::TERM].into_iter().enumerate() {
        let follows = world.start(&["narrate", "--fifo", &fifo, "--name", "follows", "--linger", "1000"]);
        eventually("a FIFO", || Path::new(&fifo).exists().then_some(()));
        std::fs::write(&fifo, std::fs::read(&lines).unwrap()).unwrap();
        until(&world, follows, "skipped");
        world.signal(follows, signal);
        let (status, log) = world.wait(follows);
        assert_eq!(status.code(), Some(i32::from(exit_code::OK)), "{log}");

        let ends = world.start(&["narrate", &lines, "--name", "ends", "--linger", "1000"]);
        until(&world, ends, "skipped");
        world.signal(ends, signal);
        let (status, log) = world.wait(ends);
        assert_eq!(status.code(), Some(i32::from(exit_code::INTERRUPTED)), "{log}");
        assert!(log.contains("interrupted: "), "{log}");

        let name = path(&world, &format!("recording-{number}"));
        let ends = world.start(&["record", &name, "--seconds", "100000"]);
        eventually("a recording", || Path::new(&name).exists().then_some(()));
        world.signal(ends, signal);
        let (status, log) = world.wait(ends);
        assert_eq!(status.code(), Some(i32::from(exit_code::INTERRUPTED)), "{log}");
        assert!(log.contains("interrupted: 0 messages in "), "{log}");

        let mut piped = world.command(&["report", "-"]);
        piped.stdin(Stdio::piped()).stderr(Stdio::piped());
        let mut piped = piped.spawn().unwrap();
        let mut said = std::io::BufReader::new(piped.stderr.take().unwrap());
        piped.stdin.as_mut().unwrap().write_all(b"not a report\n").unwrap();
        std::io::BufRead::read_line(&mut said, &mut String::new()).unwrap();
        kill_process(Pid::from_raw(piped.id().cast_signed()).unwrap(), signal).unwrap();
        assert_eq!(piped.wait().unwrap().code(), Some(i32::from(exit_code::OK)));

        // The command reads the file to its end, then waits for a planner.
        let reports = path(&world, &format!("reports-{number}"));
        std::fs::write(&reports, "not a report\n{\"report\": \"docked\"}\n").unwrap();
        let log = File::create(path(&world, "log-report")).unwrap();
        let mut whole = world.command(&["report", "-", "--wait", "1000"]);
        let mut whole = whole.stdin(File::open(&reports).unwrap()).stderr(log).spawn().unwrap();
        let log = path(&world, "log-report");
        eventually("a bad line", || std::fs::read_to_string(&log).ok().filter(|log| log.contains("line 1")));
        kill_process(Pid::from_raw(whole.id().cast_signed()).unwrap(), signal).unwrap();
        assert_eq!(whole.wait().unwrap().code(), Some(i32::from(exit_code::INTERRUPTED)));
    }
}

/// If standard error is full or closed, messages are lost and the command continues.
#[test]
fn standard_error_that_cannot_be_written_ends_no_command_by_a_panic() {
    let world = World::new("untold");
    let file = world.directory.path().join("reports");
    std::fs::write(&file, "not a report\n").unwrap();
    let full = || File::options().write(true).open("/dev/full").unwrap();
    for (arguments, code) in [
        (&["report", "-"][..], exit_code::INPUT),
        (&["habits", "learn", file.to_str().unwrap()], exit_code::INPUT),
        (&["narrate", "/nowhere/at-all"], exit_code::INPUT),
    ] {
        let mut command = world.command(arguments);
        let status = command.stdin(File::open(&file).unwrap()).stdout(Stdio::null()).stderr(full()).status().unwrap();
        assert_eq!(status.code(), Some(i32::from(code)), "{arguments:?}");
    }
}

#[test]
fn the_doctor_blames_the_part_that_is_wrong() {
    let world = World::new("doctor");
    let output = world.command(&["doctor", "--json", "--scene", "/nowhere/at-all"]).output().unwrap();
    assert_eq!(output.status.code(), Some(i32::from(exit_code::INPUT)), "a missing map has one exit code");
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let finding = |check: &str| {
        let findings = report["findings"].as_array().unwrap();
        findings.iter().find(|finding| finding["check"] == check).unwrap().clone()
    };
    let scene = finding("scene");
    assert_eq!(scene["verdict"], "wrong");
    assert!(scene["found"].as_str().unwrap().contains("no scene /nowhere/at-all"), "{scene}");
    assert_eq!(finding("model")["verdict"], "good");
    let messages = finding("messages");
    assert!(messages["found"].as_str().unwrap().contains(world.domain.root().to_str().unwrap()), "{messages}");
}

#[test]
fn a_missing_map_has_one_exit_code_and_a_misspelt_one_a_suggestion() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("roomcast.toml");
    std::fs::write(&config, "[scene]\npath = \"studoi\"\n[robot]\nleast_s = -1.0\n").unwrap();
    for arguments in [
        &["score", "--scene", "studoi", "They sit."][..],
        &["scene", "check", "studoi", "studio"],
        &["scene", "show", "studoi"],
        &["scene", "draw", "studoi"],
        &["scene", "import", "studoi", "--out", "scene.json"],
        &["demo", "--scene", "studoi"],
        &["config", "--check", config.to_str().unwrap()],
    ] {
        let output = roomcast(arguments).current_dir(folder.path()).output().unwrap();
        let said = String::from_utf8([output.stdout, output.stderr].concat()).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(exit_code::INPUT)), "{arguments:?}: {said}");
        assert!(arguments.contains(&"import") || said.contains("did you mean `studio`?"), "{arguments:?}: {said}");
    }
}

#[test]
fn verbose_commands_log_their_steps() {
    let said = |arguments: &[&str]| {
        let output = roomcast(arguments).env_remove("ROOMCAST_LOG").output().unwrap();
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stderr).unwrap()
    };
    assert_eq!(said(&["scene", "show", "studio"]), "");
    let verbose = said(&["scene", "show", "studio", "--verbose"]);
    assert!(verbose.contains("DEBUG") && verbose.contains("loaded the map"), "{verbose}");
}

#[test]
fn output_into_a_pipe_that_closes_ends_quietly() {
    for arguments in
        [&["completions", "bash"][..], &["config"], &["scene", "show", "apartment-e0", "--json"], &["help"]]
    {
        let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast"));
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output =
            command.args(arguments).stdin(Stdio::null()).stdout(writer).stderr(Stdio::piped()).output().unwrap();
        assert_eq!(String::from_utf8(output.stderr).unwrap(), "", "{arguments:?}");
    }
}

#[test]
fn output_that_cannot_be_written_is_an_error_and_no_panic() {
    let score = ["score", "--narration", "They sit."];
    for arguments in [&["completions", "bash"][..], &["config"], &["doctor"], &score, &["scene", "show", "studio"]] {
        let full = File::options().write(true).open("/dev/full").unwrap();
        let output = roomcast(arguments).stdout(full).stderr(Stdio::piped()).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(exit_code::FAILURE)), "{arguments:?}: {said}");
        assert!(said.contains("standard output: No space left on device"), "{arguments:?}: {said}");
    }
}

#[test]
fn arguments_out_of_range_or_without_effect_are_refused_before_anything_runs() {
    let score = ["score", "--narration", "They sit."];
    let explain = ["explain", "--narration", "They sit."];
    let recording = ["explain", "--recording", "day.mcap"];
    let import = ["scene", "import", "map.json", "--out", "scene.json", "--format", "virtualhome"];
    let valetudo = ["scene", "import", "map.json", "--out", "scene.json", "--format", "valetudo"];
    let cases: [(&[&str], &[&str]); 31] = [
        (&import, &["--up", "y"]),
        (&import, &["--keep-spellings"]),
        (&import, &["--names", "names.toml"]),
        (&import, &["--rules", "rules.toml"]),
        (&import, &["--token-file", "token"]),
        (&valetudo, &["--up", "y"]),
        (&valetudo, &["--keep-spellings"]),
        (&valetudo, &["--equivalence", "names.txt"]),
        (&score, &["--threads", "100000"]),
        (&score, &["--steps", "3"]),
        (&score, &["--effort", "ranking", "--method", "independent"]),
        (&score, &["--deadline-ms", "3"]),
        (&score, &["--effort", "deadline", "--deadline-ms", "0"]),
        (&score, &["--history", "0"]),
        (&score, &["--prior", "1.5"]),
        (&score, &["--prior", "nan"]),
        (&["explain", "--live"], &["--prior", "0.5"]),
        (&recording, &["--continuation", "free"]),
        (&score, &["--history", "99999999999"]),
        (&explain, &["--threads", "257"]),
        (&explain, &["--at", "3"]),
        (&explain, &["--sequence", "3"]),
        (&explain, &["--config", "/nonexistent"]),
        (&explain, &["--root", "/x"]),
        (&explain, &["--live"]),
        (&["explain", "--live"], &["--binding", "p1"]),
        (&["explain", "--live"], &["--at", "3"]),
        (&recording, &["--at", "nan"]),
        (&recording, &["--history", "3"]),
        (&recording, &["--root", "/x"]),
        (&recording, &["--scene", "flat"]),
    ];
    for (command, more) in cases {
        let mut command = roomcast(command);
        let output = command.args(more).env_remove("ROOMCAST_ROOT").env_remove("ROOMCAST_DOMAIN").output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(exit_code::USAGE)), "{command:?}: {said}");
        assert_eq!(output.stdout, b"", "{command:?}");
    }
}

/// The experiments moved from this program to roomcast-lab.
#[test]
fn the_old_name_of_an_experiment_prints_the_new_one_on_one_line() {
    let output = roomcast(&["experiment", "table2", "--json"]).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(i32::from(exit_code::USAGE)), "{said}");
    assert!(said.lines().count() == 1 && said.contains("roomcast-lab table2 --json"), "{said}");
}

#[test]
fn the_old_name_of_publish_still_works_and_prints_the_new_one() {
    let output = roomcast(&["bridge", "mqtt", "--topic", "a/#"]).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(i32::from(exit_code::CONFIG)), "{said}");
    assert!(said.contains("`roomcast publish`") && said.contains("bridge.topic"), "{said}");
}

#[test]
fn errors_name_the_file_and_the_remedy_once() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let empty = file("empty.json", "");
    let graph = file("graph.json", r#"{"nodes": [], "edges": []}"#);
    let day = file("day.txt", "wake_up (06:00 - 06:10)\n\n### wake_up-00.txt\n\n[WALK] <bedroom> (162) [1]\n370.0\n");
    let json = file("model.json", "{\n \"a\": 1}");
    let out = folder.path().join("out.json").to_str().unwrap().to_owned();
    let shipped = "studio, apartment-e0";
    let cases: [(&[&str], &[&str]); 11] = [
        (
            &["scene", "change", "studio", &empty, "--out", &out],
            &["changes /", "empty.json: the text ends too early", "a JSON list"],
        ),
        (&["scene", "change", "studio", "nope", "--out", &out], &["changes nope: cannot be read"]),
        (&["scene", "apply", &empty], &["changes /", "empty.json: the text ends too early"]),
        (&["scene", "draw", "studio", "--scores", "nope"], &["scores nope: cannot be read"]),
        (&["score", "--scene", "nowhere"], &["no scene nowhere", shipped]),
        (&["score", "--program", "nowhere"], &["program nowhere", "p0-breakfast-and-television"]),
        (&["narrate", "p0-breakfast"], &["no file p0-breakfast: ", "p0-breakfast-and-television"]),
        (&["score", "--program", &day], &["day.txt: ", "line 5 is left out", "HOMER+", "`roomcast-lab`"]),
        (&["score", "--narration", "[Teleport] <mug> (1)"], &["unknown action `Teleport`", "`walk`"]),
        (&["model", "check", "nope"], &["model file nope", "check the path"]),
        (&["model", "info", &json], &[r#"starts with "{\n \"", not with"#]),
    ];
    for (arguments, parts) in cases {
        let output = roomcast(arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && !said.contains(".: "), "{arguments:?}: {said}");
        for part in parts {
            assert_eq!(said.matches(part).count(), 1, "{arguments:?}: {part} in {said}");
        }
    }
    let output = roomcast(&["scene", "check", &graph]).output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains("graph.json: nodes: unknown key") && said.contains("`roomcast scene import`"), "{said}");
    assert!(String::from_utf8(output.stderr).unwrap().contains("1 scene with errors, 0 warnings"));
}

#[test]
fn a_number_that_does_not_fit_is_answered_with_what_does() {
    let cases: [(&[&str], &str); 12] = [
        (&["narrate", "--pace", "-1"], "give a number from 0 to 1000000000"),
        (&["narrate", "--pace", "soon"], "give a number from 0 to 1000000000"),
        (&["narrate", "--speed", "-2"], "give a number above 0, at most 1000000000"),
        (&["narrate", "--person", "-1"], "a name with a letter, or a person's number from 0 to 4294967294"),
        (&["replay", "day.mcap", "--speed", "fast"], "give a number above 0"),
        (&["replay", "day.mcap", "--linger", "-1"], "give a whole number from 0"),
        (&["record", "day.mcap", "--seconds", "0"], "give a whole number from 1"),
        (&["planner", "--room-time", "-1"], "give a number from 0 to 1000000000"),
        (&["top", "--snapshots", "-1"], "give a whole number from 0"),
        (&["score", "--prior", "-0.5", "--narration", "x"], "give a number from 0 to 1"),
        (&["score", "--threads", "many", "--narration", "x"], "give a whole number from 0 to"),
        (&["scene", "draw", "studio", "--scale", "-1"], "give a number from 0.1 to 8"),
    ];
    for (arguments, remedy) in cases {
        let output = roomcast(arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(exit_code::USAGE)), "{arguments:?}: {said}");
        assert!(said.contains(remedy), "{arguments:?}: {said}");
    }
    for arguments in [
        &["narrate", "--mqtt", "mqtt://127.0.0.1", "--rules", "rules.toml", "--speed", "2"][..],
        &["narrate", "--fifo", "/tmp/narration", "--speed", "2"],
    ] {
        let output = roomcast(arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(exit_code::USAGE)), "{arguments:?}: {said}");
        assert!(said.contains("cannot be used with"), "{arguments:?}: {said}");
    }
}

#[test]
fn recordings_that_cannot_be_are_refused_before_anything_is_written() {
    let world = World::new("record-where");
    let ended = |arguments: &[&str]| {
        let output = world.command(arguments).current_dir(world.directory.path()).output().unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let (code, said) = ended(&["record", "-", "--seconds", "1"]);
    assert_eq!(code, Some(i32::from(exit_code::USAGE)), "{said}");
    assert!(said.contains("not to standard output") && !world.directory.path().join("-").exists(), "{said}");
    let (code, said) = ended(&["record", "night.mcap", "--profile", "nonsense"]);
    assert_eq!(code, Some(i32::from(exit_code::USAGE)), "{said}");
    assert!(
        said.contains("roomcast") && said.contains("ros2") && !world.directory.path().join("night.mcap").exists(),
        "{said}"
    );
    std::fs::write(world.directory.path().join("day.mcap"), "precious").unwrap();
    let (there, said) = ended(&["record", "day.mcap", "--seconds", "1"]);
    assert!(said.contains("exists already"), "{said}");
    let (also, said) = ended(&["record", "day.mcap", "--profile", "ros2", "--seconds", "1"]);
    assert!(also == there && said.contains("exists already"), "{said}");
    assert_eq!(std::fs::read(world.directory.path().join("day.mcap")).unwrap(), b"precious");
    let (missing, said) = ended(&["replay", "night.mcap"]);
    assert!(said.contains("night.mcap"), "{said}");
    assert_eq!((there, missing), (Some(i32::from(exit_code::INPUT)), Some(i32::from(exit_code::INPUT))));
}

#[test]
fn a_configuration_is_held_to_what_this_machine_has() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("roomcast.toml");
    let check = |text: &str| {
        std::fs::write(&path, text).unwrap();
        let mut command = roomcast(&["config", "--check", path.to_str().unwrap()]);
        let output = command.env_remove("ROOMCAST_ROOT").env_remove("ROOMCAST_DOMAIN").output().unwrap();
        (output.status.success(), String::from_utf8([output.stdout, output.stderr].concat()).unwrap())
    };
    assert_eq!(check("[scene]\npath = \"ward\"\n"), (true, format!("ok: {}\n", path.display())));
    for (text, part) in [
        ("[scene]\npath = \"/nowhere/flat.json\"", "no scene /nowhere/flat.json"),
        ("[model]\npath = \"/nowhere/model.gguf\"", "/nowhere/model.gguf"),
        ("[model]\ncores = [100000]", "model.cores names core 100000"),
        (&format!("[model]\nsha256 = \"{}\"", "0".repeat(64)), "model.sha256 pins 0000"),
    ] {
        let (fine, said) = check(text);
        assert!(!fine && said.contains(part), "{text}: {said}");
    }
    // The names in a configuration are checked against the map, and all errors appear in one message.
    let text = "[scene]\npath = \"studio\"\n[robot.segments]\nkitchn = \"16\"\n";
    let mqtt = "[mqtt]\nbroker = \"10.0.0.5\"\nrules = \"home.rules.toml\"\n";
    let (fine, said) = check(&format!("{text}{mqtt}"));
    let rules = folder.path().join("home.rules.toml");
    for part in [
        "names the room \"kitchn\", which the map does not have: write \"kitchen\"; the map's rooms are kitchen, main-room, bathroom",
        "mqtt.broker: \"10.0.0.5\" is no broker: give mqtt://HOST[:PORT]",
        "here mqtt://10.0.0.5:1883",
        &format!("failed to read {}: No such file", rules.display()),
        "correct mqtt.rules in the configuration, or write rules there",
        "3 things are wrong",
    ] {
        assert!(!fine && said.contains(part), "{part} in {said}");
    }
    std::fs::write(rules, "[[rule]]\ntopic = \"a\"\nsay = \"They sit.\"\n").unwrap();
    let good = format!("{text}{mqtt}").replace("kitchn", "kitchen").replace("10.0.0.5", "mqtt://10.0.0.5");
    assert_eq!(
        check(&good),
        (true, format!("ok: {}\n", folder.path().join("roomcast.toml").display())),
        "rules lie beside their configuration, whatever the working folder"
    );
}

#[test]
fn maps_that_are_odd_are_told_of() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let whole = include_str!("../../data/two_rooms.json");
    let mut odd: serde_json::Value = serde_json::from_str(whole).unwrap();
    odd["doors"][0]["position_m"] = serde_json::json!([90, 90, 1]);
    odd["items"][0]["position_m"] = serde_json::json!([90, 90, 1]);
    let odd = file("odd.json", &odd.to_string());
    let output = roomcast(&["scene", "check", &odd, &file("half.json", &whole[..whole.len() / 2])]).output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains("doors[0] (") && said.contains("m from \"kitchen\""), "{said}");
    assert!(said.contains("items[0] (\"mug-1\"): position_m lies"), "{said}");
    assert!(said.contains("the text ends too early, in line"), "{said}");

    let polygon =
        r#"{"rooms": [{"name": "studio", "vertices": [[0, 0], [4, 0], [4, 3], [2, 4], [0, 3]]}], "objects": []}"#;
    let map = file("polygon.json", polygon);
    let out = folder.path().join("out.json");
    let arguments = ["scene", "import", "--format", "open-vocabulary", &map, "--out", out.to_str().unwrap()];
    let output = roomcast(&arguments).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let scene: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&out).unwrap()).unwrap();
    assert_eq!((&scene["version"], scene["rooms"][0]["footprint"][0].as_array().map(Vec::len)), (&2.into(), Some(5)));
}
