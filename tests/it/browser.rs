//! The page of `roomcast view` in headless Chromium, driven by chromedriver. `ROOMCAST_SCREENSHOTS=FOLDER` saves pictures of the page at three
//! widths, light and dark.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use roomcast_services::recording::{self, Recorded};
use serde_json::{Value, json};

use crate::eventually::eventually;
use crate::skipped::skipped;

const PATIENCE: Duration = Duration::from_secs(60);
/// The page shows this text and never runs it.
const HOSTILE: &str = "<img src=x onerror=document.title=666>";

struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _gone = self.0.kill();
        let _status = self.0.wait();
    }
}

fn roomcast(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast"));
    command.args(arguments).args(["--config"]).arg(folder.join("roomcast.toml")).stdin(Stdio::null());
    command
}

fn line_with(output: impl std::io::Read + Send + 'static, word: &'static str) -> String {
    let (tell, told) = std::sync::mpsc::channel();
    // The thread reads to the end, because a closed pipe would end the writer.
    std::thread::spawn(move || {
        for line in BufReader::new(output).lines().map_while(Result::ok) {
            if line.contains(word) {
                let _nobody = tell.send(line);
            }
        }
    });
    told.recv_timeout(PATIENCE).unwrap()
}

/// A browser session, by the WebDriver protocol.
struct Browser {
    session: String,
    agent: ureq::Agent,
    _driver: Running,
    _profile: tempfile::TempDir,
}

impl Drop for Browser {
    /// Without the end of the session, the browser outlives its driver.
    fn drop(&mut self) {
        let _ended = self.agent.delete(&self.session).call();
    }
}

impl Browser {
    /// `None` if no browser is installed.
    fn start() -> Option<Self> {
        let driver = Command::new("chromedriver").arg("--port=0").stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
        let Ok(mut driver) = driver else {
            skipped("chromedriver is not installed (apt-get install chromium chromium-driver)");
            return None;
        };
        let said = line_with(driver.stdout.take().unwrap(), "started successfully on port");
        let driver = Running(driver);
        let port: u16 = said.trim_end_matches('.').rsplit(' ').next().unwrap().parse().unwrap();
        let profile = tempfile::tempdir().unwrap();
        let arguments = [
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--no-first-run",
            &format!("--user-data-dir={}", profile.path().display()),
        ];
        let agent: ureq::Agent = ureq::Agent::config_builder().http_status_as_error(false).build().into();
        let mut browser =
            Self { session: format!("http://127.0.0.1:{port}/session"), agent, _driver: driver, _profile: profile };
        let wanted = json!({"capabilities": {"alwaysMatch": {"goog:chromeOptions": {"args": arguments}}}});
        let session = browser.post("", &wanted);
        browser.session.push_str(&format!("/{}", session["sessionId"].as_str().unwrap()));
        Some(browser)
    }

    fn post(&self, path: &str, body: &Value) -> Value {
        let url = format!("{}{path}", self.session);
        let mut answer = self.agent.post(&url).content_type("application/json").send(body.to_string()).unwrap();
        let text = answer.body_mut().with_config().limit(64 << 20).read_to_string().unwrap();
        let value: Value = serde_json::from_str(&text).unwrap();
        assert!(answer.status().is_success(), "{path}: {value}");
        value["value"].clone()
    }

    fn open(&self, url: &str) {
        self.post("/url", &json!({"url": url}));
    }

    fn run(&self, script: &str) -> Value {
        self.post("/execute/sync", &json!({"script": script, "args": []}))
    }

    fn text(&self, selector: &str) -> String {
        self.run(&format!("return document.querySelector({selector:?}).innerText"))
            .as_str()
            .unwrap_or_default()
            .to_owned()
    }

    fn until(&self, what: &str, script: &str) {
        eventually(what, || (self.run(script) == json!(true)).then_some(()));
    }

    fn press(&self, key: &str) {
        let actions = json!([{"type": "keyDown", "value": key}, {"type": "keyUp", "value": key}]);
        self.post("/actions", &json!({"actions": [{"type": "key", "id": "keyboard", "actions": actions}]}));
    }

    fn command(&self, command: &str, parameters: &Value) -> Value {
        self.post("/goog/cdp/execute", &json!({"cmd": command, "params": parameters}))
    }

    fn look(&self, width: u32, is_dark: bool) {
        let metrics = json!({"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600});
        self.command("Emulation.setDeviceMetricsOverride", &metrics);
        let scheme = if is_dark { "dark" } else { "light" };
        let features = json!({"features": [{"name": "prefers-color-scheme", "value": scheme}]});
        self.command("Emulation.setEmulatedMedia", &features);
        let folder = std::env::var_os("ROOMCAST_SCREENSHOTS");
        if let Some(folder) = folder {
            let picture = self.command("Page.captureScreenshot", &json!({"captureBeyondViewport": true}));
            let path = Path::new(&folder).join(format!("view-{width}-{scheme}.base64"));
            fs::write(path, picture["data"].as_str().unwrap()).unwrap();
        }
    }
}

/// The names on the plan outside their rooms, by the ends of their letters.
const OUTSIDE: &str = "return [...document.querySelectorAll('#plan .heat')].filter((room, i) => {
    const name = document.querySelectorAll('#plan text')[3 * i], box = name.getBBox(), y = box.y + 0.6 * box.height;
    return [box.x, box.x + box.width].some(x => !room.isPointInFill(new DOMPoint(x, y)));
}).map(room => room.textContent)";

const TAB: &str = "\u{e004}";
const RIGHT: &str = "\u{e014}";
const SPACE: &str = " ";

#[test]
#[ignore = "full"]
fn the_page_shows_a_running_system_in_a_real_browser() {
    let Some(browser) = Browser::start() else { return };
    let folder = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
    let root = folder.path();
    let studio = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/studio.json")).unwrap();
    fs::write(root.join("studio.json"), studio).unwrap();
    let name = format!("br-{}", std::process::id());
    let configuration = format!(
        "[ipc]\nroot = {:?}\ndomain = {name:?}\n\n[scene]\npath = {:?}\n\n[daemon]\nstate = {:?}\n",
        root.join("d"),
        root.join("studio.json"),
        root.join("state"),
    );
    fs::write(root.join("roomcast.toml"), configuration).unwrap();
    let quiet = |mut command: Command| Running(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
    let mut view = roomcast(root, &["view", "--listen", "127.0.0.1:0"]).stderr(Stdio::piped()).spawn().unwrap();
    let said = line_with(view.stderr.take().unwrap(), "open http://");
    let _view = Running(view);
    let url = said.split(' ').find(|word| word.starts_with("http://")).unwrap();

    browser.open(url.split('#').next().unwrap());
    browser.until(
        "without the key nothing is shown",
        "return document.getElementById('daemon').innerText.includes('no key')",
    );
    browser.open("about:blank");
    browser.open(url);
    browser.until(
        "the page waits for a daemon",
        "return document.getElementById('daemon').innerText.includes('No daemon')",
    );
    let daemon = quiet(roomcast(root, &["daemon"]));
    let _planner = quiet(roomcast(root, &["planner"]));
    browser.until("a plan is drawn", "return document.querySelectorAll('#plan .heat').length >= 3");
    let narrate = |text: &str| {
        let mut narrator = roomcast(root, &["narrate", "-"]);
        let mut narrator = narrator.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        narrator.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
        assert!(narrator.wait().unwrap().success());
    };
    narrate(
        "{\"person\": \"ada\", \"text\": \"They walk to the kitchen.\"}\n{\"person\": \"ada\", \"text\": \"They open the fridge.\"}\n",
    );
    narrate("{\"person\": \"ada\", \"text\": \"They grab the milk.\"}\n");
    browser.until(
        "narration is shown",
        "return document.getElementById('narration').innerText.includes('They grab the milk.')",
    );
    browser.until("a person is shown", "return document.getElementById('persons').innerText.includes('ada')");
    browser.until("a decision is shown", "return document.getElementById('robot').innerText.includes('by ')");
    browser
        .until("what is left is shown", "return document.getElementById('robot').innerText.includes('Still to do: ')");
    browser.until(
        "ada is in the kitchen",
        "return [...document.querySelectorAll('#rooms tbody tr')].some(row => row.innerText.startsWith('kitchen') && parseInt(row.cells[1].innerText) >= 50)",
    );
    browser.until(
        "things are warm",
        "return [...document.querySelectorAll('#plan .thing')].some(dot => dot.r.baseVal.value > 0)",
    );

    browser.until(
        "ada's place is a sentence",
        "return document.getElementById('persons').innerText.includes('ada: Kitchen (')",
    );
    browser.until(
        "her next hour and the robot's rooms are shown",
        "return document.querySelectorAll('#persons .hour rect').length >= 16 && document.querySelectorAll('#robot .strip li').length >= 1",
    );
    // A tap sends a click, a mouse a movement of the pointer.
    for (event, selector) in [("pointermove", "#plan .heat"), ("click", "#plan .touch"), ("click", "#persons rect")] {
        let name = browser.run(&format!(
            "const shape = document.querySelector({selector:?}); shape.dispatchEvent(new MouseEvent({event:?}, {{bubbles: true}}));
            const named = document.getElementById('named'); return named.hidden ? '' : [named.innerText, shape.dataset.name].join('|')"
        ));
        let name = name.as_str().unwrap_or_default().to_owned();
        assert!(
            name.split_once('|').is_some_and(|(shown, own)| shown == own && !shown.is_empty()),
            "{selector}: {name}"
        );
    }

    narrate(&format!("{}\n", json!({"person": "ben", "text": format!("They say {HOSTILE}")})));
    browser
        .until("hostile narration is shown as text", &format!("return document.body.innerText.includes({HOSTILE:?})"));
    assert_eq!(browser.run("return document.querySelectorAll('img, iframe, object').length"), json!(0));
    assert_eq!(browser.run("return document.title"), json!("Roomcast"));

    // A person holds the robot on the page, and lets it go on.
    let click = |order: &str| browser.run(&format!("document.querySelector('[data-order={order}]').click()"));
    click("hold");
    browser.until("the robot is held", "return document.getElementById('robot').innerText.includes('On hold')");
    click("resume");
    browser.until("the robot goes on", "return !document.getElementById('robot').innerText.includes('On hold')");
    click("skip");
    browser.until("the order is sent", "return document.getElementById('order-text').innerText === 'Sent.'");
    let other = "return fetch('order?kind=clean&room=0&map=other', {method: 'POST', headers: {'x-roomcast-key': location.hash.slice(1)}}).then(answer => answer.status)";
    assert_eq!(browser.run(other), json!(400), "an order for another map");

    // The keyboard suffices: the first tab stop is the horizon.
    browser.run("document.activeElement.blur()");
    browser.press(TAB);
    assert_eq!(browser.run("return document.activeElement.id"), json!("horizon"));
    assert_eq!(browser.text("#horizon-text"), "now");
    browser.press(RIGHT);
    assert_eq!(browser.text("#horizon-text"), "in 5 s");
    let end = "const slider = document.getElementById('horizon'); slider.value = slider.max; slider.dispatchEvent(new Event('input'))";
    browser.run(end);
    assert_eq!(browser.text("#horizon-text"), "in 1 h");
    browser.press(TAB);
    assert_eq!(browser.run("return document.activeElement.id"), json!("pause"));
    browser.press(SPACE);
    assert_eq!(browser.text("#pause"), "Go on");
    browser.press(SPACE);
    assert_eq!(browser.text("#pause"), "Pause");

    for width in [360, 1280, 2560] {
        for is_dark in [false, true] {
            browser.look(width, is_dark);
            assert_eq!(
                browser.run("return document.documentElement.scrollWidth <= innerWidth"),
                json!(true),
                "{width}"
            );
        }
    }
    let paper = |is_dark| {
        browser.look(1280, is_dark);
        browser.run("return getComputedStyle(document.body).backgroundColor")
    };
    assert_ne!(paper(false), paper(true), "dark where the system is dark");

    // When the daemon dies, the page shows it, and continues with the next daemon.
    drop(daemon);
    browser.until("the daemon is silent", "return document.getElementById('daemon').className === 'alarm'");
    let _daemon = quiet(roomcast(root, &["daemon"]));
    browser.until("the daemon is back", "return document.getElementById('daemon').innerText.includes('alive')");
    browser.until("ada is still known", "return document.getElementById('persons').innerText.includes('ada')");
}

/// A hall around a corner, with its centre outside, and a room too narrow for its name in the usual size.
const CORNERS: &str = r#"{"format": "roomcast-scene", "version": 2, "name": "corners", "rooms": [
    {"id": "hall-1", "label": "hall", "footprint": [[[0, 0], [9, 0], [9, 1.6], [1.6, 1.6], [1.6, 9], [0, 9]]], "floor": 0, "height": 2.5},
    {"id": "den-2", "label": "den", "footprint": [[[1.8, 1.8], [7.2, 1.8], [7.2, 9], [1.8, 9]]], "floor": 0, "height": 2.5},
    {"id": "laundry-3", "label": "laundry room", "footprint": [[[7.4, 1.8], [9, 1.8], [9, 9], [7.4, 9]]], "floor": 0, "height": 2.5}],
  "doors": [{"id": "den-door", "rooms": ["hall-1", "den-2"], "position_m": [1.7, 5.0, 1.0]}, {"id": "laundry-door", "rooms": ["hall-1", "laundry-3"], "position_m": [8.0, 1.7, 1.0]}],
  "items": [{"id": "mirror", "label": "mirror", "position_m": [0.5, 5, 1], "box": {"min_m": [0.4, 4.9, 0.9], "max_m": [0.6, 5.1, 1.1]}},
    {"id": "sofa", "label": "sofa", "position_m": [4, 5, 0.4], "box": {"min_m": [3, 4.5, 0], "max_m": [5, 5.5, 0.8]}},
    {"id": "washer", "label": "washing machine", "position_m": [8, 5, 0.4], "box": {"min_m": [7.7, 4.7, 0], "max_m": [8.3, 5.3, 0.8]}}]}"#;

#[test]
#[ignore = "full"]
fn the_page_of_a_recording_offers_what_it_has_and_names_fit_their_rooms() {
    let Some(browser) = Browser::start() else { return };
    let folder = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
    let root = folder.path();
    fs::write(root.join("corners.json"), CORNERS).unwrap();
    let configuration = format!(
        "[ipc]\nroot = {:?}\ndomain = \"rb-{}\"\n\n[scene]\npath = {:?}\n",
        root.join("d"),
        std::process::id(),
        root.join("corners.json"),
    );
    fs::write(root.join("roomcast.toml"), configuration).unwrap();
    let quiet = |mut command: Command| Running(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
    let _daemon = quiet(roomcast(root, &["daemon"]));
    let file = root.join("day.mcap").display().to_string();
    let mut record = roomcast(root, &["record", &file]).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    // The recorder creates its file when it listens; earlier events are not recorded.
    eventually("the recording is there", || root.join("day.mcap").exists().then_some(()));
    let mut narrator = roomcast(root, &["narrate", "-"]).stdin(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    let said = "{\"person\": \"ada\", \"presence\": \"present\", \"room\": \"laundry-3\"}\n";
    narrator.stdin.take().unwrap().write_all(said.as_bytes()).unwrap();
    assert!(narrator.wait().unwrap().success());
    eventually("the recording has the map, the narration and its scores", || {
        let recording = recording::read(&root.join("day.mcap")).ok().filter(|own| !own.maps.is_empty())?;
        let of = |is: fn(&Recorded) -> bool| recording.messages.iter().rposition(|(_, message)| is(message));
        let narrated = of(|message| matches!(message, Recorded::Narration(_)))?;
        (of(|message| matches!(message, Recorded::RoomScores(_)))? > narrated).then_some(())
    });
    rustix::process::kill_process(rustix::process::Pid::from_child(&record), rustix::process::Signal::TERM).unwrap();
    assert!(record.wait().unwrap().success());

    let arguments = ["view", "--listen", "127.0.0.1:0", "--recording", &file];
    let mut view = Command::new(env!("CARGO_BIN_EXE_roomcast")).args(arguments).stderr(Stdio::piped()).spawn().unwrap();
    let said = line_with(view.stderr.take().unwrap(), "open http://");
    let _view = Running(view);
    browser.look(360, false);
    browser.open(said.split(' ').find(|word| word.starts_with("http://")).unwrap());
    browser.until("a plan is drawn", "return document.querySelectorAll('#plan .heat').length === 3");
    browser
        .until("what was said is there", "return document.getElementById('narration').innerText.includes('laundry')");
    assert!(browser.text("#narration").contains("present in the laundry room"), "{}", browser.text("#narration"));
    let shown = |id: &str| browser.run(&format!("return document.getElementById({id:?}).offsetParent !== null"));
    assert_eq!(
        ["horizon", "time", "play", "pause", "items"].map(shown),
        [true, true, true, false, false].map(Value::from)
    );
    // The page shows the last position of a drag, even if it comes during a request. Each request takes 200 ms here.
    browser.run(
        "window.promptly = window.fetch;
        window.fetch = async (...of) => { await new Promise(later => setTimeout(later, 200)); return window.promptly(...of); };
        const time = document.getElementById('time');
        time.focus();
        [0.1, 0.9, 0.4, 0].forEach((part, i) => setTimeout(() => {
            time.value = part * time.max;
            time.dispatchEvent(new Event('input'));
        }, 50 * i));",
    );
    browser.until(
        "the drag's last moment is shown",
        "return state.at_s === 0 && document.getElementById('time').value === '0'",
    );
    browser.run("window.fetch = window.promptly");
    // At the end of the slider all events are shown, and playback stops there.
    browser.run(
        "const time = document.getElementById('time'); time.value = time.max; time.dispatchEvent(new Event('input'))",
    );
    browser.until("the end is the end", "return state.at_s === state.length_s");
    browser.run("const time = document.getElementById('time'); time.value = 0.9 * time.max; time.dispatchEvent(new Event('input'))");
    browser.run("document.getElementById('play').click()");
    browser.until(
        "it stops at its end",
        "return document.getElementById('play').innerText === 'Play' && state.at_s === state.length_s",
    );
    // A state that the page cannot draw is not reported as a lost connection.
    browser.run(
        "window.fetch = async (...of) => { const answer = await window.promptly(...of); const state = await answer.json(); state.persons = null; return { ok: true, json: async () => state }; };
        document.getElementById('play').click();",
    );
    browser.until("it was asked for", "return state.persons === null");
    assert_eq!(browser.text("#daemon"), "A recording.");
    browser.run("window.fetch = window.promptly; document.getElementById('play').click()");
    for width in [360, 1280, 2560] {
        browser.look(width, false);
        let fits = format!("const outside = (() => {{ {OUTSIDE} }})(); return outside.length === 0");
        browser.until(&format!("names fit at {width}"), &fits);
    }
}
