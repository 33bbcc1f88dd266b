//! Reads a home's rooms and rules: from a Home Assistant's configuration folder, or over its WebSocket API.

use std::path::Path;

use super::Failure;
use super::scene_files::{in_file, input, read, write};
#[cfg(feature = "whole")]
use crate::home_assistant;
use roomcast_core::semantic_map::import::{self, Home, Registries};

pub(super) fn is_url(source: &Path) -> bool {
    let schemes = ["http://", "https://", "ws://", "wss://"];
    source.to_str().is_some_and(|source| schemes.iter().any(|scheme| source.starts_with(scheme)))
}

#[derive(Clone, Copy, Default)]
pub(super) struct HomeOptions<'a> {
    pub(super) token_file: Option<&'a Path>,
    pub(super) authority: Option<&'a Path>,
    pub(super) registries: Registries<'a>,
}

pub(super) fn home_assistant(source: &Path, name: &str, options: HomeOptions<'_>) -> Result<Home, Failure> {
    if is_url(source) {
        return over_network(source, name, options);
    }
    if !source.exists() {
        let source = source.display();
        let text = format!(
            "{source} is neither a folder that is there nor an address; give the folder that configuration.yaml is in, or the address, such as http://HOST:8123"
        );
        return Err(input(text));
    }
    if options.token_file.is_some() || options.authority.is_some() {
        let source = source.display();
        let text = format!(
            "a token is for an address, and {source} is a folder; give http://HOST:8123, or leave --token-file out"
        );
        return Err(Failure::usage(text));
    }
    from_folder(source, name, options.registries)
}

#[cfg(feature = "whole")]
fn over_network(source: &Path, name: &str, options: HomeOptions<'_>) -> Result<Home, Failure> {
    let url = source.to_string_lossy();
    let Some(token) = options.token_file else {
        let text =
            "give --token-file FILE with a long-lived access token (Home Assistant, your profile's page, Security)";
        return Err(Failure::usage(text));
    };
    let fetched = home_assistant::fetch(&url, token, options.authority).map_err(input)?;
    let Registries { leave_out, residents, furnished, .. } = options.registries;
    import::home_assistant(&Registries { leave_out, residents, furnished, ..fetched.registries() }, name)
        .map_err(|error| in_file(&format!("Home Assistant {} at", fetched.version), source, &error))
}

#[cfg(not(feature = "whole"))]
fn over_network(source: &Path, _: &str, _: HomeOptions<'_>) -> Result<Home, Failure> {
    let source = source.display();
    Err(input(format!(
        "{source}: this build has no network; give the configuration folder, or build without --no-default-features"
    )))
}

fn from_folder(folder: &Path, name: &str, options: Registries<'_>) -> Result<Home, Failure> {
    let inner = folder.join(".storage");
    let storage = if inner.is_dir() { &inner } else { folder };
    let (areas, registry) = (storage.join("core.area_registry"), "registry");
    if !areas.is_file() {
        let folder = folder.display();
        let problem = format!(
            "{folder} has no .storage/core.area_registry; give the folder that configuration.yaml is in, or the address, such as http://HOST:8123"
        );
        return Err(input(problem));
    }
    let optional = |name: &str| {
        let path = storage.join(name);
        path.is_file().then(|| read(registry, &path)).transpose()
    };
    let (floors, devices) = (optional("core.floor_registry")?, optional("core.device_registry")?);
    let (entities, persons) = (optional("core.entity_registry")?, optional("person")?);
    let texts = Registries {
        areas: &read(registry, &areas)?,
        floors: floors.as_deref(),
        devices: devices.as_deref(),
        entities: entities.as_deref(),
        persons: persons.as_deref(),
        ..options
    };
    import::home_assistant(&texts, name).map_err(|error| in_file("Home Assistant", storage, &error))
}

pub(super) fn check_rules(path: &Path, rules: &str) -> Result<(), Failure> {
    #[cfg(feature = "whole")]
    roomcast_services::mqtt::Rules::parse(rules)
        .map_err(|fault| input(format!("the rules for {} cannot be used: {fault}", path.display())))?;
    #[cfg(not(feature = "whole"))]
    let _unread = (path, rules);
    Ok(())
}

/// Writes rules unless the file exists: a user may have edited it.
pub(super) fn write_rules(path: &Path, rules: &str) -> Result<String, Failure> {
    if path.exists() {
        let path = path.display();
        return Ok(format!("{path}: is there and stays as it is; remove it, or give --rules, for new rules"));
    }
    check_rules(path, rules)?;
    write(path, rules.as_bytes())?;
    Ok(format!(
        "{path}: {}; edit them, then look at what they say: roomcast narrate --mqtt URL --rules {path} --dry-run",
        super::count(rules.matches("[[rule]]").count(), "rule"),
        path = path.display(),
    ))
}
