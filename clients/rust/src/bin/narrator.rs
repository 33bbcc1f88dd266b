//! Reports where a person is and what they do, and prints how the daemon understood it: `narrator ada kitchen "opens the fridge"`.

use std::time::Duration;

use roomcast_ipc::{Domain, Error};

fn main() -> Result<(), Error> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let [person, room, action] = words.as_slice() else {
        eprintln!("usage: narrator PERSON ROOM ACTION");
        std::process::exit(2);
    };
    let mut camera = Domain::for_user()?.narrator("hall-camera")?;
    camera.present(person, Some(room))?;
    let understood = camera.did(person, action)?.confirmed(Duration::from_secs(10))?;
    let persons: Vec<_> = understood.persons.iter().filter_map(|own| own.name.as_deref()).collect();
    let place = understood.place.as_deref().unwrap_or("no place of the map");
    println!("{} is {}: {place}", persons.join(" and "), understood.presence);
    camera.close()
}
