//! `plantctl token`: the tokens that let people into a server, in the file that its `auth.tokens` names.

use std::fmt::Write as _;
use std::io::Write as _;
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _, PermissionsExt as _, fchown};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use base64::Engine as _;
use base64::prelude::BASE64_URL_SAFE_NO_PAD;
use clap::{Args, Subcommand, ValueEnum};
use ring::digest::{SHA256, digest};
use serde::{Deserialize, Serialize};
use serde_json::json;
use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;

use crate::input::files::from_toml;
use crate::output::page::{Cell, Page, Table, table};
use crate::server::context::Context;

/// Random bytes of a token.
const SECRET_BYTES: usize = 32;
const SECONDS_PER_DAY: f64 = 86_400.0;
/// Longest life of a token, days: a century.
const DAYS_MAX: f64 = 36_525.0;

/// Make, list and revoke tokens that let people into a server. The file has no token, only what a token is known by;
/// the server reads it again within two seconds.
#[derive(Debug, Args)]
pub(crate) struct Token {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Make a token, and show it: it is shown once, and cannot be found out again.
    New {
        /// Whose it is; stands in the server's log.
        name: String,
        /// What they may do: look, change what is their tenant's, or change everything.
        #[arg(long, default_value = "driver")]
        role: Role,
        /// Whose plants they use.
        #[arg(long, default_value = "default")]
        tenant: String,
        /// Days for which it counts; for good if not given.
        #[arg(long, value_name = "DAYS")]
        days: Option<f64>,
        #[command(flatten)]
        file: TokensPath,
    },
    /// List the tokens.
    List {
        #[command(flatten)]
        file: TokensPath,
    },
    /// Take tokens away; streams that were opened with them end.
    Revoke {
        /// Whose.
        name: String,
        #[command(flatten)]
        file: TokensPath,
    },
}

#[derive(Debug, Args)]
struct TokensPath {
    /// The server's file of tokens.
    #[arg(
        long,
        value_name = "FILE",
        env = "PLANTD_TOKENS",
        default_value = "/etc/plantd/tokens.toml"
    )]
    file: PathBuf,
}

/// What the holder of a token may do.
#[derive(Clone, Copy, Debug, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "snake_case")]
enum Role {
    /// Look.
    Viewer,
    /// Change what is the tenant's.
    Driver,
    /// Change everything, of all tenants.
    Admin,
}

/// The file.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Tokens {
    #[serde(default)]
    tokens: Vec<Entry>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    sha256: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    tenant: Option<String>,
    role: Role,
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        with = "time::serde::rfc3339::option"
    )]
    expires: Option<OffsetDateTime>,
}

impl Token {
    pub(crate) fn run(self, context: &Context) -> Result<()> {
        match self.action {
            Action::New { name, role, tenant, days, file } => {
                let token = make(&file.file, name, role, tenant, days)?;
                context.output.print(
                    || json!({ "token": token }),
                    || {
                        let mut page = Page::from(format!("{token}\n"));
                        page.data(table(&["token"], [vec![token.as_str()]]));
                        page
                    },
                )
            }
            Action::List { file } => {
                let tokens = Tokens::read(&file.file)?;
                context.output.print(|| tokens.to_json(), || tokens.to_table())
            }
            Action::Revoke { name, file } => {
                let mut tokens = Tokens::read(&file.file)?;
                let before = tokens.tokens.len();
                tokens.tokens.retain(|entry| entry.name != name);
                let count = before - tokens.tokens.len();
                ensure!(count > 0, "there is no token `{name}` in {}", file.file.display());
                tokens.write(&file.file)?;
                let said = format!("{count} revoked");
                context.output.done(json!({ "revoked": count }), &said)
            }
        }
    }
}

/// Makes a token, and writes down what it is known by.
fn make(
    path: &Path,
    name: String,
    role: Role,
    tenant: String,
    days: Option<f64>,
) -> Result<String> {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    let is_tenant = !tenant.is_empty() && tenant.len() <= 64 && !tenant.starts_with('.');
    ensure!(
        is_tenant && tenant.chars().all(is_plain),
        "`{tenant}` is no name of a tenant: letters, digits and `-_.`, at most 64"
    );
    let expires = match days {
        None => None,
        Some(days) if days > 0.0 && days <= DAYS_MAX => {
            let life = time::Duration::seconds_f64(days * SECONDS_PER_DAY);
            Some((OffsetDateTime::now_utc() + life).replace_nanosecond(0)?)
        }
        Some(days) => bail!("--days is {days}; it must lie between 0 and {DAYS_MAX}"),
    };
    let mut tokens = match path.exists() {
        true => Tokens::read(path)?,
        false => Tokens::default(),
    };
    ensure!(
        tokens.tokens.iter().all(|entry| entry.name != name),
        "there already is a token `{name}` in {}: revoke it, or take another name",
        path.display()
    );
    let mut secret = [0; SECRET_BYTES];
    let count = rustix::rand::getrandom(&mut secret, rustix::rand::GetRandomFlags::empty())?;
    ensure!(count == SECRET_BYTES, "the system gives no random numbers");
    let token = format!("plantd_{}", BASE64_URL_SAFE_NO_PAD.encode(secret));
    let mut sha256 = String::new();
    for byte in digest(&SHA256, token.as_bytes()).as_ref() {
        write!(sha256, "{byte:02x}")?;
    }
    tokens.tokens.push(Entry { name, sha256, tenant: Some(tenant), role, expires });
    tokens.write(path)?;
    Ok(token)
}

impl Tokens {
    fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
        from_toml(&text).with_context(|| path.display().to_string())
    }

    /// Writes beside the file and renames: whoever reads sees all or nothing. Owner and mode stay.
    fn write(&self, path: &Path) -> Result<()> {
        let failed = || format!("cannot write {}", path.display());
        let mut partial = path.as_os_str().to_owned();
        partial.push(".partial");
        let mut options = std::fs::OpenOptions::new();
        let mut file = options
            .write(true)
            .create(true)
            .truncate(true)
            .mode(0o600)
            .open(&partial)
            .with_context(failed)?;
        if let Ok(former) = std::fs::metadata(path) {
            file.set_permissions(std::fs::Permissions::from_mode(former.mode() & 0o7777))?;
            // Who may write to the folder, but is another user, cannot give files away.
            let _ = fchown(&file, Some(former.uid()), Some(former.gid()));
        }
        file.write_all(toml::to_string(self)?.as_bytes()).with_context(failed)?;
        file.sync_all()?;
        std::fs::rename(&partial, path).with_context(failed)
    }

    fn to_json(&self) -> serde_json::Value {
        let entry = |entry: &Entry| {
            let (tenant, expires) = (entry.tenant.as_deref(), entry.expires());
            json!({ "name": entry.name, "tenant": tenant, "role": entry.role, "expires": expires })
        };
        json!({ "tokens": self.tokens.iter().map(entry).collect::<Vec<_>>() })
    }

    fn to_table(&self) -> Table {
        let row = |entry: &Entry| {
            let role = match entry.role {
                Role::Viewer => "viewer",
                Role::Driver => "driver",
                Role::Admin => "admin",
            };
            let tenant = entry.tenant.as_deref().unwrap_or("default");
            let expires = entry.expires().unwrap_or_else(|| "never".to_owned());
            [entry.name.as_str(), tenant, role, expires.as_str()].map(Cell::from).to_vec()
        };
        table(&["token", "tenant", "role", "expires"], self.tokens.iter().map(row))
    }
}

impl Entry {
    fn expires(&self) -> Option<String> {
        self.expires.and_then(|expires| expires.format(&Rfc3339).ok())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_made_once_and_written_down_as_what_they_are_known_by() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens.toml");
        let new = |name: &str, tenant: &str, days| {
            make(&path, name.to_owned(), Role::Driver, tenant.to_owned(), days)
        };
        let token = new("anna", "lab", Some(1.0)).unwrap();
        assert_eq!(token.len(), "plantd_".len() + 43);
        assert_ne!(new("bert", "lab", None).unwrap(), token);
        assert!(new("anna", "lab", None).unwrap_err().to_string().contains("`anna`"));
        assert!(new("carl", "a/b", None).unwrap_err().to_string().contains("`a/b`"));
        assert!(
            new("carl", "lab", Some(f64::NAN)).is_err() && new("carl", "lab", Some(0.0)).is_err()
        );
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(!text.contains(&token) && text.contains("name = \"anna\""), "{text}");
        assert_eq!(std::fs::metadata(&path).unwrap().mode() & 0o777, 0o600);
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o640)).unwrap();
        let mut tokens = Tokens::read(&path).unwrap();
        assert!(tokens.tokens[0].expires.unwrap() > OffsetDateTime::now_utc());
        tokens.tokens.remove(0);
        tokens.write(&path).unwrap();
        assert_eq!(std::fs::metadata(&path).unwrap().mode() & 0o777, 0o640);
        assert_eq!(Tokens::read(&path).unwrap().tokens.len(), 1);
    }
}
