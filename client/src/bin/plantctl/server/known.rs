//! Servers with names, in a file of the user's: where they are, and who the user is there.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail};
use plantd_client::Credentials;
use plantd_scene::{UnknownName, in_plain_words};
use serde::Deserialize;

/// A server of the file.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct KnownServer {
    /// Its address.
    pub(crate) address: String,
    token: Option<String>,
    token_file: Option<PathBuf>,
    ca: Option<PathBuf>,
    cert: Option<PathBuf>,
    key: Option<PathBuf>,
}

impl KnownServer {
    /// The server of that name in the user's file.
    pub(crate) fn named(name: &str) -> Result<Self> {
        Self::find(name, &path()?)
    }

    fn find(name: &str, path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("servers with names: {}", path.display()))?;
        let servers: Result<BTreeMap<String, Self>, _> = toml::from_str(&text);
        // The parser would show the line, which may be that of a token.
        let mut servers = servers.map_err(|error| {
            anyhow::anyhow!("{}: {}", path.display(), in_plain_words(error.message()))
        })?;
        let Some(server) = servers.remove(name) else {
            let names: Vec<_> = servers.keys().map(String::as_str).collect();
            let name = UnknownName::among(name, &names);
            bail!("{}: there is no server {name}", path.display());
        };
        Ok(server)
    }

    /// Who the user is there. Paths begin where the file is.
    pub(crate) fn credentials(&self) -> Result<Credentials> {
        let folder = path()?.parent().map(Path::to_owned).unwrap_or_default();
        let beside = |path: &Option<PathBuf>| path.as_ref().map(|path| folder.join(path));
        let token = match beside(&self.token_file) {
            Some(path) => Some(read_token(&path)?),
            None => self.token.clone(),
        };
        let [ca, cert, key] = [&self.ca, &self.cert, &self.key].map(beside);
        Ok(Credentials { token, ca, cert, key })
    }
}

/// The token in a file.
pub(crate) fn read_token(path: &Path) -> Result<String> {
    let text = std::fs::read_to_string(path);
    Ok(text.with_context(|| format!("token in {}", path.display()))?.trim().to_owned())
}

/// `$XDG_CONFIG_HOME/plantd/servers.toml` or `~/.config/plantd/servers.toml`.
fn path() -> Result<PathBuf> {
    let set = |name| std::env::var_os(name).filter(|path| !path.is_empty()).map(PathBuf::from);
    let folder = set("XDG_CONFIG_HOME").or_else(|| set("HOME").map(|home| home.join(".config")));
    let folder = folder.context("neither XDG_CONFIG_HOME nor HOME says where `servers.toml` is")?;
    Ok(folder.join("plantd").join("servers.toml"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn servers_are_found_by_their_names() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let text = "[lab]\naddress = \"https://lab:50051\"\ntoken = \"abc\"\nca = \"lab.pem\"\n";
        std::fs::write(file.path(), text).unwrap();
        let lab = KnownServer::find("lab", file.path()).unwrap();
        assert_eq!(
            (lab.address.as_str(), lab.token.as_deref()),
            ("https://lab:50051", Some("abc"))
        );
        let error = KnownServer::find("home", file.path()).unwrap_err().to_string();
        assert!(error.ends_with("there is no server `home`; there is `lab`"), "{error}");
        std::fs::write(file.path(), "[lab]\naddress = 3\ntoken = \"abc\"\n").unwrap();
        let error = format!("{:#}", KnownServer::find("lab", file.path()).unwrap_err());
        assert!(!error.contains("abc"), "{error}");
    }
}
