//! The file of bearer tokens. It has their SHA-256, from which nobody can find them.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use ring::digest::{SHA256, SHA256_OUTPUT_LEN, digest};
use serde::{Deserialize, Serialize};
use subtle::ConstantTimeEq as _;
use time::OffsetDateTime;

use crate::core::tenant::{Tenants, is_tenant_name};
use crate::wire::edge::auth::credential::{Credential, Over, Principal};
use crate::wire::edge::auth::file::{self, FileError};
use crate::wire::edge::auth::role::Role;
use crate::wire::edge::auth::settings::DEFAULT_TENANT;

type Hash = [u8; SHA256_OUTPUT_LEN];

/// The file, as it is written.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct TokenFile {
    tokens: Vec<TokenEntry>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct TokenEntry {
    name: String,
    sha256: String,
    #[serde(default)]
    tenant: Option<String>,
    role: Role,
    #[serde(default, with = "time::serde::rfc3339::option")]
    expires: Option<OffsetDateTime>,
}

/// The tokens in force.
#[derive(Debug, Default)]
pub(super) struct Tokens {
    /// By the first bytes of the hash, which say nothing of the token.
    by_hash: HashMap<[u8; 8], Vec<(Hash, Arc<Credential>)>>,
}

impl Tokens {
    /// Reads a file. What was known before and has not changed stays what it is; what is no more is ended.
    pub(super) fn read(path: &Path, tenants: &Tenants, former: &Self) -> Result<Self, FileError> {
        let wrong = |problem| FileError { what: "tokens", path: path.to_owned(), problem };
        let file: TokenFile = file::read(path).map_err(wrong)?;
        let mut tokens = Self::default();
        for entry in file.tokens {
            let name = entry.name.clone();
            let (hash, credential) = entry
                .credential(tenants)
                .map_err(|problem| wrong(format!("token `{name}`: {problem}")))?;
            let known = former.get(&hash).filter(|known| {
                known.principal == credential.principal && known.expires == credential.expires
            });
            let credential = known.map_or(credential, Arc::clone);
            tokens.by_hash.entry(start(&hash)).or_default().push((hash, credential));
        }
        let now = SystemTime::now();
        tokens.end_expired(now);
        for (hash, credential) in former.all() {
            let is_kept = tokens.get(hash).is_some_and(|kept| Arc::ptr_eq(kept, credential));
            if !is_kept {
                credential.end(Over::Revoked);
            }
        }
        Ok(tokens)
    }

    /// Whose token this is.
    pub(super) fn find(&self, token: &[u8]) -> Option<&Arc<Credential>> {
        let hash = digest(&SHA256, token);
        self.get(&hash.as_ref().try_into().ok()?)
    }

    fn get(&self, hash: &Hash) -> Option<&Arc<Credential>> {
        let candidates = self.by_hash.get(&start(hash))?;
        let found = candidates.iter().find(|(known, _)| bool::from(known.ct_eq(hash)));
        found.map(|(_, credential)| credential)
    }

    fn all(&self) -> impl Iterator<Item = &(Hash, Arc<Credential>)> {
        self.by_hash.values().flatten()
    }

    /// How many there are.
    pub(super) fn count(&self) -> usize {
        self.all().count()
    }

    /// Ends those whose time has passed.
    pub(super) fn end_expired(&self, now: SystemTime) {
        self.all().for_each(|(_, credential)| credential.end_if_expired(now));
    }
}

fn start(hash: &Hash) -> [u8; 8] {
    let mut start = [0; 8];
    start.copy_from_slice(&hash[..8]);
    start
}

impl TokenEntry {
    fn credential(self, tenants: &Tenants) -> Result<(Hash, Arc<Credential>), String> {
        let Self { name, sha256, tenant, role, expires } = self;
        let hash = from_hex(&sha256).ok_or("`sha256` takes 64 hexadecimal digits")?;
        let tenant_name = tenant.unwrap_or_else(|| DEFAULT_TENANT.to_owned());
        if !is_tenant_name(&tenant_name) {
            return Err(format!("`{tenant_name}` is no name of a tenant: letters, digits, `-_.`"));
        }
        let tenant = tenants.named(&tenant_name);
        let principal = Principal { name, tenant, tenant_name, role };
        Ok((hash, Credential::new(principal, expires.map(SystemTime::from))))
    }
}

fn from_hex(text: &str) -> Option<Hash> {
    let digit = |byte: u8| char::from(byte).to_digit(16).map(|digit| digit as u8);
    let mut hash = [0; SHA256_OUTPUT_LEN];
    if text.len() != 2 * hash.len() {
        return None;
    }
    for (byte, pair) in hash.iter_mut().zip(text.as_bytes().chunks_exact(2)) {
        *byte = digit(pair[0])? << 4 | digit(pair[1])?;
    }
    Some(hash)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::core::room::Room;

    fn tenants() -> Tenants {
        let room = Room::new("numbers", "numbers", 1);
        Tenants::new(true, BTreeMap::new(), &room, &room)
    }

    fn hex(token: &[u8]) -> String {
        digest(&SHA256, token).as_ref().iter().map(|byte| format!("{byte:02x}")).collect()
    }

    fn entry(name: &str, rest: &str) -> String {
        let hash = hex(name.as_bytes());
        format!("[[tokens]]\nname = \"{name}\"\nsha256 = \"{hash}\"\n{rest}\n")
    }

    fn read(text: &str, former: &Tokens, tenants: &Tenants) -> Result<Tokens, FileError> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        Tokens::read(file.path(), tenants, former)
    }

    #[test]
    fn tokens_are_found_by_their_hash_until_they_are_over() {
        let tenants = tenants();
        let anna = entry("anna", "tenant = \"lab\"\nrole = \"driver\"");
        let bert = entry("bert", "role = \"viewer\"\nexpires = \"2001-01-01T00:00:00Z\"");
        let tokens = read(&format!("{anna}{bert}"), &Tokens::default(), &tenants).unwrap();
        let found = Arc::clone(tokens.find(b"anna").unwrap());
        let principal = &found.principal;
        assert_eq!((principal.tenant_name.as_str(), principal.role), ("lab", Role::Driver));
        assert_eq!(principal.tenant, tenants.named("lab"));
        assert!(tokens.find(b"carl").is_none() && tokens.find(b"").is_none());
        let expired = tokens.find(b"bert").unwrap();
        assert_eq!(expired.over(), Some(Over::Expired));
        assert_eq!(expired.principal.tenant_name, DEFAULT_TENANT);

        let again = read(&anna, &tokens, &tenants).unwrap();
        assert!(Arc::ptr_eq(again.find(b"anna").unwrap(), &found) && found.over().is_none());
        let changed = read(&anna.replace("driver", "viewer"), &again, &tenants).unwrap();
        assert_eq!(found.over(), Some(Over::Revoked));
        let changed = Arc::clone(changed.find(b"anna").unwrap());
        assert_eq!((changed.over(), changed.principal.role), (None, Role::Viewer));
    }

    #[test]
    fn what_is_wrong_in_a_file_is_named_and_ends_nobody() {
        let tenants = tenants();
        let good = entry("anna", "role = \"driver\"");
        let tokens = read(&good, &Tokens::default(), &tenants).unwrap();
        for (text, said) in [
            (good.replace("driver", "king"), "king"),
            (entry("bert", "role = \"viewer\"\ntenant = \"a/b\""), "a/b"),
            (good.replace("sha256 = \"", "sha256 = \"0"), "64 hexadecimal digits"),
            (entry("bert", "role = \"viewer\"\nexpires = \"soon\""), "line "),
            (good.replace("name", "nom"), "nom"),
        ] {
            let error = read(&text, &tokens, &tenants).unwrap_err().to_string();
            assert!(error.contains(said), "{said}: {error}");
        }
        assert!(tokens.find(b"anna").unwrap().over().is_none());
    }
}
