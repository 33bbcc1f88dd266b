use super::absences::says_away;
use super::*;
use roomcast_core::ids::PersonId;

const RULES: &str = include_str!("../../../tests/data/sensor-rules.toml");
const LOG: &str = include_str!("../../../tests/data/sensors.tsv");

fn said(log: &SensorLog) -> Vec<(String, f64)> {
    log.said.iter().map(|said| (said.item.text.clone(), said.item.duration_s)).collect()
}

#[test]
fn the_documented_example_is_narrated_in_the_order_of_time() {
    let log = SensorRules::parse(RULES).unwrap().narrate(LOG.as_bytes(), &Who::Somebody);
    let sentences: Vec<String> = said(&log).into_iter().map(|(text, _)| text).collect();
    assert_eq!(
        sentences,
        [
            "They get up from the bed.",
            "They walk to the bathroom.",
            "They flush the toilet.",
            "They walk to the kitchen.",
            "They open the fridge.",
            "They close the fridge.",
            "They switch on the coffee maker.",
        ]
    );
    // The person leaves the bed at 07:12:40; 20 seconds later the bathroom is occupied.
    assert_eq!((Some(log.said[0].at_s), said(&log)[1].1), (seconds("2024-03-01 07:12:40"), 20.0));
    assert_eq!((log.unfit, log.silent), (1, 2));
    assert_eq!(log.faults.count(), 0);
}

#[test]
fn malformed_lines_are_named_and_the_others_are_said() {
    let rules = SensorRules::parse("[[rule]]\nsay = \"They open the {sensor}.\"").unwrap();
    let log = "start,end,sensor,kind,place\n2024-03-01 08:00:00,2024-03-01 08:00:05,fridge,door,kitchen\nyesterday,,fridge,door,kitchen\n\
               2024-03-01 08:00:09,2024-03-01 08:00:05,fridge,door,kitchen\n10,20\n30,40,oven,door,kitchen\n50,60,a\u{7}b,door,kitchen\n";
    let narrated = rules.narrate(log.as_bytes(), &Who::Somebody);
    let errors = narrated.faults.told();
    assert_eq!((errors.len(), narrated.faults.count()), (4, 4), "{errors:?}");
    for (error, part) in errors.iter().zip([
        "line 3: \"yesterday\" is no time",
        "line 4: it ends before",
        "line 5: it has 2 of 5 fields",
        "line 7: ",
    ]) {
        assert!(error.starts_with(part), "{error}");
    }
    assert_eq!(said(&narrated).len(), 2);
}

/// A sensor "tv; upstairs" turned a log of commas into one of semicolons, and no line could be read.
#[test]
fn a_separator_in_a_field_is_none_of_the_log() {
    let rules = SensorRules::parse("[[rule]]\nsay = \"They use the {sensor}.\"").unwrap();
    let fields = ["2024-03-01 08:00:00", "2024-03-01 08:00:05", "tv", "plug", "hall"];
    for (separator, others) in [(",", ";\t"), (";", ","), ("\t", ";,")] {
        for other in others.chars() {
            let of = |sensor: &str| fields.join(separator).replace("tv", sensor);
            let log = [of("tv"), of(&format!("\"tv{other} upstairs\"")), of("tv")].join("\n");
            assert_eq!(rules.intervals(log.as_bytes()).len(), 3, "{log}");
        }
    }
}

#[test]
fn columns_can_stand_in_any_order_and_some_can_be_left_out() {
    let rules = "columns = [\"-\", \"sensor\", \"start\"]\n[[rule]]\nsensor = \"Front_Door\"\nperson = 2\nsay = \"They leave by the {sensor}.\"";
    let narrated =
        SensorRules::parse(rules).unwrap().narrate(b"1;front_door;100\n2;FRONT_DOOR;160.5\n", &Who::Somebody);
    assert_eq!(
        said(&narrated),
        [("They leave by the front door.".to_owned(), 0.0), ("They leave by the front door.".to_owned(), 60.5)]
    );
    assert!(narrated.said.iter().all(|said| said.item.person == Who::Number(PersonId(2))));
}

#[test]
fn sensors_say_who_is_where() {
    let rules = "[[rule]]\nkind = \"PIR\"\npresence = \"present\"\nroom = \"{place}\"\nagain_s = 300.0\n\
        [[rule]]\nsensor = \"front_door\"\nat = \"end\"\npresence = \"away\"\nperson = \"ada\"\nquiet_s = 600.0";
    let rules = SensorRules::parse(rules).unwrap();
    let log = "0,5,ceiling,PIR,Living_Room\n100,110,front_door,Magnetic,Hall\n200,205,ceiling,PIR,Living_Room\n\
        1000,1010,front_door,Magnetic,Hall\n1300,1310,front_door,Magnetic,Hall\n5000,5001,ceiling,PIR,Kitchen\n\
        5100,5110,front_door,Magnetic,Hall\n";
    let log = rules.narrate(log.as_bytes(), &Who::Number(PersonId(4)));
    let said: Vec<_> = log.said.iter().map(|said| &said.item).collect();
    let ada = Who::Name("ada".to_owned());
    let told: Vec<_> = said.iter().map(|item| (item.text.as_str(), item.person.clone(), item.duration_s)).collect();
    assert_eq!(
        told,
        [
            ("present in the living room", Who::Number(PersonId(4)), 0.0),
            // At 110 the door closes. At 200 there is a motion, which is not narrated again.
            ("away", ada.clone(), 1910.0),
            ("present in the kitchen", Who::Number(PersonId(4)), 3090.0),
            ("away", ada, 710.0),
        ]
    );
    assert!(said.iter().all(|item| item.kind == roomcast_ipc::raw::narration_kind::PRESENCE));
    assert_eq!((log.unfit, log.silent), (0, 3));
}

#[test]
fn the_same_sentence_of_another_place_is_said() {
    let rules = "[[rule]]\nsay = \"They open the door.\"\nagain_s = 30.0";
    let log =
        b"0,1,a,Magnetic,kitchen\n10,11,b,Magnetic,bathroom\n20,21,a,Magnetic,kitchen\n60,61,a,Magnetic,kitchen\n";
    let log = SensorRules::parse(rules).unwrap().narrate(log, &Who::Somebody);
    assert_eq!(log.said.iter().map(|said| said.at_s).collect::<Vec<_>>(), [0.0, 10.0, 60.0]);
    assert_eq!(log.silent, 1);
}

/// The place does not matter: the whole home is silent.
#[test]
fn what_begins_to_wait_again_takes_the_place_of_what_waited() {
    let rules = "[[rule]]\nkind = \"Magnetic\"\npresence = \"away\"\nquiet_s = 600.0\n\
        [[rule]]\nkind = \"PIR\"\nat = \"end\"\npresence = \"empty\"\nroom = \"{place}\"";
    let log = b"0,1,front_door,Magnetic,hall\n300,301,back_door,Magnetic,kitchen\n2000,2010,ceiling,PIR,Living_Room\n";
    let log = SensorRules::parse(rules).unwrap().narrate(log, &Who::Number(PersonId(4)));
    let told: Vec<_> = log.said.iter().map(|said| (said.item.text.as_str(), said.at_s)).collect();
    assert_eq!(told, [("away", 900.0), ("nobody in the living room", 2010.0)]);
    assert_eq!((log.silent, log.said[1].item.person.clone()), (1, Who::Somebody));
}

#[test]
fn malformed_rules_are_named() {
    for (text, part) in [
        ("", "0 rules; give 1 to 4096, each begins with [[rule]]"),
        ("[[rule]]\nsay = \"They {value}.\"", "rule 1: say has {value}; it knows {sensor}, {kind}, {place}, {seconds}"),
        ("[[rule]]\npresence = \"away\"\nroom = \"hall\"", "rule 1: room goes with"),
        ("[[rule]]\npresence = \"away\"\nquiet_s = -1", "rule 1: quiet_s is -1"),
        ("[[rule]]\nsay = \"\"", "rule 1"),
        ("[[rule]]\nsay = \"They sit.\"\nshortest_s = -1.0", "rule 1: shortest_s"),
        ("columns = [\"sensor\"]\n[[rule]]\nsay = \"They sit.\"", "columns has \"start\" 0 times"),
        ("[[rule]]\nsays = \"They sit.\"", "unknown key"),
        (
            "[[rule]]\npresence = \"unknown\"",
            "unknown word `unknown`, expected one of `present`, `away`, `gone`, `empty`",
        ),
        ("[[rule]]\npresence = \"empty\"", "rule 1: presence = \"empty\" says that nobody is in a room: it needs room"),
    ] {
        let error = SensorRules::parse(text).unwrap_err();
        assert!(error.contains(part), "{text}: {error}");
    }
}

#[test]
fn absences_are_read_from_intervals_of_either_kind() {
    let times = |log: &[u8]| absences(log).unwrap().intervals;
    assert_eq!(times(b"10\t20\n30\t40\n"), [(10.0, 20.0), (30.0, 40.0)]);
    let mixed = b"start;end;what\n10;20;Sleeping\n20;40;Leaving\n50;60;leave-house\n60;70;Leaving\n";
    let labels = [("Leaving".to_owned(), 2), ("leave-house".to_owned(), 1)].into();
    let intervals = vec![(20.0, 40.0), (50.0, 60.0), (60.0, 70.0)];
    assert_eq!(absences(mixed).unwrap(), Absences { intervals, labels, others: 1 });
    let home = b"start,end,what\n50,60,present\n0,20,at home\n15,30,present\n";
    assert_eq!(times(home), [(30.0, 50.0)]);
    assert!(absences(b"10,20,Sleeping\n").unwrap_err().contains("third column"));
    assert!(absences(b"10,20,x\nnoon,20,x\n").unwrap_err().starts_with("line 2"));
    // A heading has no time.
    assert!(absences(b"noon\t2024-03-01 08:18:00\n").unwrap_err().starts_with("line 1"));
    assert_eq!(times(b""), []);
}

/// Labels of public data sets that contain such a word and mean something else.
#[test]
fn a_label_says_who_is_out_as_a_whole() {
    for away in [
        "away",
        "Out",
        "GONE",
        "Leaving",
        "leave house",
        "Leave_Home",
        "leaving the house",
        "Going out to work",
        "Went out for shopping",
        "out of the house",
        "away from home",
        "not at home",
        "Left the home for work",
    ] {
        assert_eq!(says_away(away), Some(true), "{away}");
    }
    for home in ["present", "Home", "at home", "in", "in the house", "indoors"] {
        assert_eq!(says_away(home), Some(false), "{home}");
    }
    for other in [
        "Putting away dishes",
        "Putting away groceries",
        "Taking out the trash",
        "Sleep_Out_Of_Bed",
        "Lawnwork outside",
        "Working from home",
        "Getting in bed",
        "Leftovers",
        "",
        "left arm",
        "Come home",
        "Washing out the sink",
    ] {
        assert_eq!(says_away(other), None, "{other}");
    }
}

/// An empty column is empty, whatever separates columns. Several tabs between the times align columns.
#[test]
fn an_empty_field_moves_no_column() {
    let rules = SensorRules::parse("[[rule]]\nsay = \"They open the {sensor}.\"").unwrap();
    let day = "2024-03-01 08:00:00";
    let read = |fields: &[&str], separator: &str| {
        let line = fields.join(separator) + "\n";
        rules.intervals(line.as_bytes()).pop().map(|read| (read.sensor, read.kind, read.place))
    };
    let is = |sensor: &str, kind: &str, place: &str| Some((sensor.into(), kind.into(), place.into()));
    for separator in ["\t", ";", ","] {
        assert_eq!(read(&[day, day, "fridge", "", "Kitchen", "Cooking"], separator), is("fridge", "", "Kitchen"));
        assert_eq!(read(&[day, day, "fridge", "door", ""], separator), is("fridge", "door", ""));
        assert_eq!(read(&[day, day, "fridge", "", "", "Cooking", "x"], separator), is("fridge", "", ""));
        assert_eq!(read(&[day, day, "fridge", "door"], separator), None);
    }
    let aligned = [day, "", day, "", "Bed", "", "", "Pressure", "Bedroom"];
    assert_eq!(read(&aligned, "\t"), is("Bed", "Pressure", "Bedroom"));
    assert_eq!(read(&aligned, ";"), None);
    let faults = |line: &str| rules.narrate(line.as_bytes(), &Who::Somebody).faults.told().to_vec();
    let wrong = format!("{day}\t\tnoon\t\tBed\t\tPressure\tBedroom\n");
    assert!(faults(&wrong)[0].starts_with("line 1: \"noon\" is no time"), "{:?}", faults(&wrong));
    assert!(faults("1709280900000,1709280905000,fridge,-,-\n")[0].ends_with("are these milliseconds?"));
}

/// Two intervals may begin at the same time.
#[test]
fn what_is_said_says_of_which_interval() {
    let rules = SensorRules::parse("[[rule]]\nsay = \"They walk to the {place}.\"").unwrap();
    let log = b"start,end,sensor,kind,place\nx\n20,25,a,PIR,kitchen\n10,15,b,PIR,hall\n10,11,c,PIR,bath\n";
    let all = rules.intervals(log);
    let said = rules.narrate(log, &Who::Somebody).said;
    assert_eq!(said.iter().map(|said| (said.line, said.at_s)).collect::<Vec<_>>(), [(4, 10.0), (5, 10.0), (3, 20.0)]);
    for said in said {
        assert!(said.item.text.contains(&all[said.interval].place), "{said:?}");
    }
}

/// On 25 October 2026 clocks in Europe go back from 03:00 to 02:00.
#[test]
fn an_interval_over_the_end_of_summer_time_has_its_length() {
    let rules = SensorRules::parse("[[rule]]\nsay = \"They sit on the {sensor} for {seconds} s.\"").unwrap();
    let read = |start: &str, end: &str| {
        let log = rules.narrate(format!("{start},{end},sofa,-,-\n").as_bytes(), &Who::Somebody);
        log.said.first().map(|said| said.item.text.clone()).ok_or_else(|| log.faults.told().to_vec())
    };
    for (start, end, seconds) in [
        ("2026-10-25 02:30:00", "2026-10-25 02:10:00", 2_400),
        ("2026-10-25T02:59:59", "2026-10-25T02:00:00", 1),
        // In New York on 1 November.
        ("2026/11/01 01:45:00", "2026/11/01 01:30:00", 2_700),
        // If the clock goes forward, the times stay as written.
        ("2026-10-25 02:10:00", "2026-10-25 02:30:00", 1_200),
    ] {
        assert_eq!(read(start, end), Ok(format!("They sit on the sofa for {seconds} s.")));
    }
    for (start, end) in [
        // A Saturday; by day; by more than an hour; over midnight; in UTC, which has no summer time; seconds.
        ("2026-10-24 02:30:00", "2026-10-24 02:10:00"),
        ("2026-10-25 08:30:00", "2026-10-25 08:10:00"),
        ("2026-10-25 02:30:00", "2026-10-25 01:10:00"),
        ("2026-10-25 00:10:00", "2026-10-24 23:50:00"),
        ("2026-10-25 02:30:00Z", "2026-10-25 02:10:00Z"),
        ("1792895400", "1792894200"),
    ] {
        assert!(read(start, end).unwrap_err()[0].contains("it ends before it begins"), "{start} {end}");
    }
}

/// Home Assistant's history has times in UTC; habits use local hours.
#[test]
fn times_that_say_their_zone_are_those_of_the_home() {
    let rules = SensorRules::parse("[[rule]]\nsay = \"They sit on the {sensor} for {seconds} s.\"").unwrap();
    let berlin = rules.clone().in_zone(Zone::of_variable(Some("CET-1CEST,M3.5.0,M10.5.0/3".as_ref())).unwrap());
    let starts = |rules: &SensorRules, start: &str, end: &str| {
        let log = rules.narrate(format!("{start},{end},sofa,-,-\n").as_bytes(), &Who::Somebody);
        log.said.first().map(|said| (said.at_s, said.item.text.clone()))
    };
    let at = |time: &str, said_s: u32| Some((seconds(time).unwrap(), format!("They sit on the sofa for {said_s} s.")));
    for (start, end, local) in [
        ("2026-11-20T08:30:00Z", "2026-11-20T08:31:00Z", "2026-11-20 09:30:00"),
        ("2026-07-20T08:30:00.0Z", "2026-07-20T08:31:00Z", "2026-07-20 10:30:00"),
        ("2026-11-20T08:30:00+09:00", "2026-11-20T08:31:00+0900", "2026-11-20 00:30:00"),
        ("2026-11-20 08:30:00-05:00", "2026-11-20 08:31:00-05:00", "2026-11-20 14:30:00"),
        ("1784536200", "1784536260", "2026-07-20 10:30:00"),
        // A local time, and numbers without a known origin.
        ("2026-11-20 08:30:00", "2026-11-20 08:31:00", "2026-11-20 08:30:00"),
        ("17", "77", "1970-01-01 00:00:17"),
        // The clock is set back within the interval.
        ("2026-10-25T00:59:30Z", "2026-10-25T01:00:30Z", "2026-10-25 02:59:30"),
    ] {
        assert_eq!(starts(&berlin, start, end), at(local, 60), "{start}");
    }
    // A time with a zone has no fold.
    assert_eq!(starts(&berlin, "2026-10-25 02:30:00Z", "2026-10-25 02:10:00Z"), None);
    assert_eq!(starts(&rules, "2026-11-20T08:30:00Z", "2026-11-20T08:31:00Z"), at("2026-11-20 08:30:00", 60));
    for wrong in ["2026-11-20T08:30:00ZZ", "2026-11-20T08:30:00+1", "2026-11-20T08:30:00+99:00", "2026-11-20-05:00"] {
        assert_eq!(seconds(wrong), None, "{wrong}");
    }
}

#[test]
fn times_are_read_as_the_data_sets_write_them() {
    assert_eq!(seconds("1970-01-01 00:00:00"), Some(0.0));
    assert_eq!(seconds("2024-03-01T00:00:00Z"), Some(1_709_251_200.0));
    assert_eq!(seconds("2024/02/29 23:59:59.5"), Some(1_709_251_199.5));
    assert_eq!(seconds("17.25"), Some(17.25));
    assert_eq!(seconds("2024-02-29 00:00:60.5"), Some(1_709_164_860.5));
    assert_eq!([seconds("0001-01-01 00:00:00"), seconds("-5")], [Some(-62_135_596_800.0), Some(-5.0)]);
    let no_times = ["", "noon", "2024-03-01", "2024-03-01 25:00:00", "inf", "nan", "1709280900000"];
    let no_dates = ["2024-13-01 00:00:00", "2024-02-31 10:00:00", "2023-02-29 10:00:00", "2024-04-31 10:00:00"];
    for wrong in no_times.into_iter().chain(no_dates).chain(["0000-01-01 00:00:00", "2024-00-01 00:00:00"]) {
        assert_eq!(seconds(wrong), None, "{wrong}");
    }
}

/// Row "a stray quotation mark in a sensor log" of the attacks.
#[test]
fn a_stray_quotation_mark_costs_its_own_line_alone() {
    let rules = SensorRules::parse("[[rule]]\nsay = \"They open the {sensor}.\"").unwrap();
    let mut lines: Vec<_> = (0..500).map(|n| format!("{n}\t{n}\tdoor{n}\tmagnetic\thall")).collect();
    lines[100] = "100\t\"100\tdoor100\tmagnetic\thall".to_owned();
    let narrated = rules.narrate(lines.join("\r\n").as_bytes(), &Who::Somebody);
    let wrong = narrated.faults.told();
    assert_eq!((narrated.said.len(), wrong.len()), (499, 1));
    assert!(wrong[0].starts_with("line 101:"), "{wrong:?}");
    // A quoted field may contain the separator.
    let quoted = rules.narrate(b"1,2,\"door, left\",magnetic,hall\n", &Who::Somebody);
    assert_eq!(quoted.said[0].item.text, "They open the door, left.");
}

/// Row "a sensor log of malformed lines" of the attacks: memory does not grow with them.
#[test]
fn malformed_lines_are_counted_and_the_first_are_told() {
    let rules = SensorRules::parse("[[rule]]\nsay = \"They open the {sensor}.\"").unwrap();
    let long = "y".repeat(4_000);
    let too_long = "z".repeat(LINE_BYTES_MAX as usize + 1);
    let fields = "8,".repeat(4_000);
    let log = format!(
        "start,end,sensor,kind,place\n{long},1,door,-,-\n{too_long}\n{fields}\n{}1,2,fridge,-,-\n",
        "x\n".repeat(100_000)
    );
    let SensorLog { said, faults, .. } = rules.narrate(log.as_bytes(), &Who::Somebody);
    let said: Vec<_> = said.iter().map(|said| said.item.text.as_str()).collect();
    assert_eq!(said, ["They open the fridge.", "They open the 8."]);
    assert_eq!((faults.count(), faults.told().len()), (100_002, Faults::TOLD));
    let told = faults.told();
    assert!(told[0].starts_with("line 2: \"yyyy") && told[0].contains("yy\"... is no time"), "{}", told[0]);
    assert_eq!(told[1], "line 3: it has more than 8192 bytes");
    assert!(told[2].starts_with("line 5: it has 1 of 5 fields"), "{}", told[2]);
    assert!(told.iter().all(|text| text.len() < 200), "{told:?}");
}

/// Earlier lines do not matter: a byte order mark, carriage returns, open quotation marks.
#[test]
fn each_line_is_read_as_if_it_were_alone() {
    let rules = SensorRules::parse("[[rule]]\nsay = \"They open the {sensor}.\"").unwrap();
    let line = [
        "1,2,door,-,-",
        "\u{feff}3,4,door,-,-",
        "5,6,\"door",
        "",
        "7,8,door,-,-\r",
        "\"9\",\"10\",\"a \"\"b\"\"\",-,-",
        "-----",
    ];
    let all = rules.intervals(line.join("\n").as_bytes());
    let alone: Vec<_> = line.iter().flat_map(|line| rules.intervals(format!("\n{line}").as_bytes())).collect();
    assert_eq!(all, alone);
    assert_eq!(all.iter().map(|interval| interval.start_s).collect::<Vec<_>>(), [1.0, 3.0, 7.0, 9.0]);
    assert_eq!(all[3].sensor, "a \"b\"");
}

#[test]
fn open_intervals_are_said_at_their_start_alone() {
    let rules = "columns = [\"start\", \"end\", \"sensor\"]\n[[rule]]\nshortest_s = 60\nsay = \"They use the {sensor} for {seconds} s.\"\n\
        [[rule]]\nat = \"end\"\nsay = \"They leave the {sensor}.\"";
    let rules = SensorRules::parse(rules).unwrap();
    for end in ["", "NaT", "unknown", "-"] {
        let log = format!(
            "start,end,sensor\n2024-03-01 07:00:00,{end},kettle\n2024-03-01 07:10:00,2024-03-01 07:12:00,oven\n"
        );
        let log = rules.narrate(log.as_bytes(), &Who::Somebody);
        let texts: Vec<String> = said(&log).into_iter().map(|(text, _)| text).collect();
        assert_eq!(
            texts,
            ["They use the kettle for 720 s.", "They use the oven for 120 s.", "They leave the oven."],
            "{end}"
        );
        assert_eq!(log.faults.count(), 0);
    }
    assert!(absences(b"10,20\n30,\n").unwrap_err().contains("line 2: its end is missing"));
}

#[test]
fn a_first_line_that_begins_with_a_time_is_no_heading() {
    let rules =
        SensorRules::parse("columns = [\"start\", \"sensor\", \"kind\"]\n[[rule]]\nsay = \"They sit.\"").unwrap();
    for first in [
        "2010-11-04 00:03:50.209589 M003 ON Sleeping begin",
        "2010-13-04 M003",
        "25-Feb-2008 x",
        "1709280900 M003 ON",
        "00:03:50 M003",
        "07:13 1 March 2010,M003",
    ] {
        let faults =
            rules.narrate(format!("{first}\n2010-11-04 00:03:57 M003 OFF\n").as_bytes(), &Who::Somebody).faults;
        assert_eq!(faults.count(), 2, "{first}");
        assert!(faults.told()[0].starts_with("line 1: "), "{first}");
    }
    let heading = rules.narrate(b"Start time,Sensor 1,Kind\n10,sofa,x\n", &Who::Somebody);
    assert_eq!((heading.faults.count(), heading.said.len()), (0, 1));
}

/// The format of CASAS.
#[test]
fn date_and_time_may_stand_in_two_columns() {
    let rules =
        |columns: &str| SensorRules::parse(&format!("columns = [{columns}]\n[[rule]]\nsay = \"They sit.\"")).unwrap();
    let log = b"2010-11-04,00:03:50.25,M003,ON,Sleeping begin\n2010-11-04,08:11:09,D001,OPEN,\n";
    let read = rules("\"start\", \"-\", \"sensor\", \"kind\"").intervals(log);
    assert_eq!(
        read.iter().map(|read| read.start_s).collect::<Vec<_>>(),
        ["2010-11-04 00:03:50.25", "2010-11-04 08:11:09"].map(|time| seconds(time).unwrap())
    );
    assert_eq!((read[1].sensor.as_str(), read[1].kind.as_str()), ("D001", "OPEN"));
    let both = rules("\"start\", \"-\", \"end\", \"-\", \"sensor\"")
        .intervals(b"25-Feb-2008\t00:20:14\t25-Feb-2008\t00:22:57\tfridge\n");
    assert_eq!(both[0].end_s - both[0].start_s, 163.0);
    let unnamed = rules("\"start\", \"sensor\", \"kind\"").narrate(log, &Who::Somebody).faults;
    assert!(
        unnamed.told()[0].ends_with("name the column behind it \"-\" if the time of the day stands there"),
        "{:?}",
        unnamed.told()
    );
}

/// Home Assistant's "Download data" of its history: one line per change, in UTC.
#[test]
fn the_history_export_of_home_assistant_is_narrated() {
    let rules = "columns = [\"sensor\", \"kind\", \"start\"]\n[[rule]]\nsensor = \"light.kitchen\"\nkind = \"on\"\nsay = \"They turn on the kitchen light.\"";
    let log = b"entity_id,state,last_changed\nlight.kitchen,off,2024-03-01T06:00:00.000Z\nlight.kitchen,on,2024-03-01T07:12:40.123Z\n\
        sensor.kitchen_temperature,21.5,2024-03-01T07:13:00.000Z\n";
    let log = SensorRules::parse(rules).unwrap().narrate(log, &Who::Somebody);
    assert_eq!(said(&log), [("They turn on the kitchen light.".to_owned(), 0.0)]);
    assert_eq!((log.said[0].at_s, log.unfit, log.faults.count()), (seconds("2024-03-01 07:12:40.123").unwrap(), 2, 0));
}

#[test]
fn months_may_have_english_names() {
    for (text, same) in [
        ("25-Feb-2008 00:20:14", "2008-02-25 00:20:14"),
        ("1/MAY/2024 08:15:00.5", "2024-05-01 08:15:00.5"),
        ("25 February 2008 00:20:14", "2008-02-25 00:20:14"),
        ("Feb 25, 2008 00:20:14", "2008-02-25 00:20:14"),
        ("25.02.2008 00:20:14", "2008-02-25 00:20:14"),
        ("31-October-2024T23:59:59Z", "2024-10-31 23:59:59"),
    ] {
        assert_eq!(seconds(text), seconds(same), "{text}");
    }
    for wrong in [
        "30-Feb-2008 00:20:14",
        "25-Foo-2008 00:20:14",
        "25-F-2008 00:20:14",
        "2008-Feb-25 00:20:14",
        "25-Feb-2008",
        "02/03/2008 00:20:14",
    ] {
        assert_eq!(seconds(wrong), None, "{wrong}");
    }
}

fn reports(log: &SensorLog) -> Vec<(f64, String)> {
    log.said.iter().map(|said| (said.at_s, said.item.text.clone())).collect()
}

#[test]
fn an_interval_of_a_sensor_is_on_from_start_to_end() {
    let rules = "[[rule]]\nkind = \"PIR\"\nas = \"motion\"\nroom = \"{place}\"\nshortest_s = 1.0\n\
        [[rule]]\nkind = \"Pressure\"\nas = \"bed\"\nroom = \"bedroom\"\nperson = \"ada\"\nid = \"bed\"\n\
        [[rule]]\nkind = \"Pressure\"\nat = \"end\"\nsay = \"They get up from the {sensor}.\"";
    let log = b"0,60,bed,Pressure,Bedroom\n70,75,ceiling,PIR,Bath\n70,70.5,ceiling,PIR,Hall\n80,-,ceiling,PIR,Bath\n\
        90,91,fridge,Magnetic,Kitchen\n";
    let log = SensorRules::parse(rules).unwrap().narrate(log, &Who::Somebody);
    let bath = |on: bool| format!(r#"{{"sensor":"motion","id":"Bath/ceiling","room":"bath","on":{on}}}"#);
    let bed = |on: bool| format!(r#"{{"sensor":"bed","id":"bed","room":"bedroom","on":{on}}}"#);
    assert_eq!(
        reports(&log),
        [
            (0.0, bed(true)),
            (60.0, "They get up from the bed.".to_owned()),
            (60.0, bed(false)),
            (70.0, bath(true)),
            (75.0, bath(false)),
            (80.0, bath(true)),
        ]
    );
    assert_eq!(log.said[0].item.person, Who::Name("ada".to_owned()));
    assert_eq!((log.unfit, log.silent, log.faults.count()), (1, 2, 0));
}

#[test]
fn a_log_of_states_gives_each_state_of_a_sensor_once() {
    let rules = "columns = [\"sensor\", \"kind\", \"start\"]\n\
        [[rule]]\nsensor = \"binary_sensor.hall\"\nas = \"presence\"\nroom = \"hall\"\n\
        [[rule]]\nsensor = \"sensor.kettle\"\nas = \"appliance\"\nroom = \"kitchen\"\nabove = 15\nid = \"kettle\"\n\
        [[rule]]\nsensor = \"beam\"\nas = \"motion\"\nroom = \"hall\"\nonly_on = true";
    let log = b"binary_sensor.hall,on,100\nbinary_sensor.hall,on,110\nbinary_sensor.hall,unavailable,120\n\
        binary_sensor.hall,off,130\nsensor.kettle,2,140\nsensor.kettle,3,141\nsensor.kettle,2000,150\n\
        beam,on,160\nbeam,on,170\nbeam,off,180\nsensor.kettle,much,190\n";
    let log = SensorRules::parse(rules).unwrap().narrate(log, &Who::Somebody);
    let states: Vec<(f64, bool, &str)> = (log.said.iter())
        .map(|said| (said.at_s, said.item.text.contains("\"on\":true"), said.item.text.split('"').nth(3).unwrap()))
        .collect();
    assert_eq!(
        states,
        [
            (100.0, true, "presence"),
            (120.0, false, "presence"),
            (130.0, false, "presence"),
            (140.0, false, "appliance"),
            (150.0, true, "appliance"),
            (160.0, true, "motion"),
            (170.0, true, "motion"),
        ]
    );
    assert!(log.said[1].item.text.contains("\"on\":null"), "{}", log.said[1].item.text);
    assert_eq!((log.silent, log.faults.count()), (2, 1));
}

#[test]
fn faults_of_sensor_rules_are_named() {
    for (rule, fault) in [
        ("as = \"motion\"\nroom = \"hall\"\nat = \"end\"", "at and again_s go with say or presence"),
        ("as = \"motion\"\nroom = \"hall\"\nwhen = \"on\"", "in a log without the column \"end\""),
        ("say = \"They sit.\"\nabove = 3", "go with as"),
        ("as = \"radar\"\nroom = \"hall\"", "radar"),
        ("as = \"phone\"", "needs the person"),
    ] {
        let error = SensorRules::parse(&format!("[[rule]]\n{rule}")).unwrap_err();
        assert!(error.contains(fault), "{rule}: {error}");
    }
    for (columns, rule, fault) in [
        ("\"start\", \"sensor\"", "as = \"motion\"\nroom = \"hall\"", "as needs the column"),
        ("\"start\", \"sensor\", \"kind\"", "kind = \"on\"\nas = \"motion\"\nroom = \"hall\"", "leave kind out"),
    ] {
        let error = SensorRules::parse(&format!("columns = [{columns}]\n[[rule]]\n{rule}")).unwrap_err();
        assert!(error.contains(fault), "{rule}: {error}");
    }
}

#[test]
fn every_example_of_the_manual_is_a_rules_file() {
    const MANUAL: &str = include_str!("../../../docs/sensors.md");
    let blocks = MANUAL.split("```toml\n").skip(1).filter_map(|rest| rest.split("```").next());
    let rules = blocks.filter(|block| block.contains("[[rule]]"));
    let numbers: Vec<usize> = rules.map(|block| SensorRules::parse(block).unwrap().rules.len()).collect();
    assert_eq!(numbers, [1, 6, 2, 2]);
}
