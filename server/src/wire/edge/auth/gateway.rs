//! Whom a gateway speaks for: a proxy that knows its callers by itself (by tokens that others have signed, say) and
//! tells the server in headers who they are.
//!
//! Headers count on a connection alone whose other end a rule calls a gateway, by its certificate or as a user of this
//! machine; elsewhere they say nothing.

use std::time::{Duration, SystemTime};

use tonic::codegen::http::HeaderMap;

use crate::core::tenant::is_tenant_name;
use crate::wire::edge::auth::role::Role;

/// How the caller is called.
const USER: &str = "plantd-user";
/// Whose plants the caller uses.
const TENANT: &str = "plantd-tenant";
/// What the caller may do.
const ROLE: &str = "plantd-role";
/// Until when the caller is who it is, seconds since 1970, as `exp` of a JWT.
const EXPIRES: &str = "plantd-expires";

/// Longest name of a caller, bytes.
const NAME_BYTES_MAX: usize = 128;

/// What a gateway says of a caller.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct Said {
    pub(super) name: String,
    pub(super) tenant: Option<String>,
    pub(super) role: Option<Role>,
    /// Seconds since 1970.
    expires_s: Option<u64>,
}

/// A header that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct HeaderError {
    header: &'static str,
    problem: &'static str,
}

impl std::fmt::Display for HeaderError {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "the gateway's header `{}` {}", self.header, self.problem)
    }
}

impl Said {
    /// Whether headers name a caller.
    pub(super) fn is_in(headers: &HeaderMap) -> bool {
        headers.contains_key(USER)
    }

    /// What they say.
    pub(super) fn read(headers: &HeaderMap) -> Result<Self, HeaderError> {
        let is_name = |name: &str| {
            !name.is_empty() && name.len() <= NAME_BYTES_MAX && !name.contains(char::is_control)
        };
        let name = one(headers, USER)?.filter(|name| is_name(name));
        let problem = "has to be a name of 128 bytes at most";
        let name = name.ok_or(HeaderError { header: USER, problem })?.to_owned();
        let tenant = one(headers, TENANT)?.map(str::to_owned);
        if tenant.as_deref().is_some_and(|tenant| !is_tenant_name(tenant)) {
            let problem = "has to be the name of a tenant: letters, digits and `-_.`, 64 at most";
            return Err(HeaderError { header: TENANT, problem });
        }
        let role = one(headers, ROLE)?.map(|role| {
            let problem = "has to be `viewer`, `driver` or `admin`";
            Role::named(role).ok_or(HeaderError { header: ROLE, problem })
        });
        let expires_s = one(headers, EXPIRES)?.map(|expires| {
            let problem = "has to be a time in whole seconds since 1970";
            expires.parse().map_err(|_| HeaderError { header: EXPIRES, problem })
        });
        Ok(Self { name, tenant, role: role.transpose()?, expires_s: expires_s.transpose()? })
    }

    /// Until when it counts; none for ever.
    pub(super) fn expires(&self) -> Option<SystemTime> {
        SystemTime::UNIX_EPOCH.checked_add(Duration::from_secs(self.expires_s?))
    }
}

/// Takes the headers out: they have done their work, and nobody behind the door is to know them.
pub(super) fn strip(headers: &mut HeaderMap) {
    for header in [USER, TENANT, ROLE, EXPIRES] {
        headers.remove(header);
    }
}

/// A header that may be there once: what a caller has sent and the gateway has added to is believed by nobody.
fn one<'a>(headers: &'a HeaderMap, header: &'static str) -> Result<Option<&'a str>, HeaderError> {
    let mut values = headers.get_all(header).iter();
    let value = values.next().map(|value| value.to_str());
    if values.next().is_some() {
        return Err(HeaderError { header, problem: "is there more than once" });
    }
    value.transpose().map_err(|_| HeaderError { header, problem: "has to be plain text" })
}

#[cfg(test)]
mod tests {
    use super::*;
    use tonic::codegen::http::{HeaderName, HeaderValue};

    fn read(headers: &[(&'static str, &str)]) -> Result<Said, String> {
        let pairs = headers.iter().map(|(name, value)| {
            (HeaderName::from_static(name), HeaderValue::from_bytes(value.as_bytes()).unwrap())
        });
        let mut map = HeaderMap::new();
        for (name, value) in pairs {
            map.append(name, value);
        }
        Said::read(&map).map_err(|error| error.to_string())
    }

    #[test]
    fn headers_say_who_somebody_is() {
        let anna = read(&[(USER, "anna")]).unwrap();
        assert_eq!((anna.name.as_str(), &anna.tenant, anna.role), ("anna", &None, None));
        assert_eq!(anna.expires(), None);
        let all = [(USER, "a@b.c"), (TENANT, "lab"), (ROLE, "viewer"), (EXPIRES, "17")];
        let all = read(&all).unwrap();
        assert_eq!((all.tenant.as_deref(), all.role), (Some("lab"), Some(Role::Viewer)));
        assert_eq!(all.expires(), Some(SystemTime::UNIX_EPOCH + Duration::from_secs(17)));
    }

    #[test]
    fn what_cannot_be_used_is_named() {
        for (headers, header) in [
            (vec![], USER),
            (vec![(USER, "")], USER),
            (vec![(USER, "a"), (USER, "b")], USER),
            (vec![(USER, "\u{fc}")], USER),
            (vec![(USER, "a"), (TENANT, "../b")], TENANT),
            (vec![(USER, "a"), (TENANT, "b"), (TENANT, "b")], TENANT),
            (vec![(USER, "a"), (ROLE, "king")], ROLE),
            (vec![(USER, "a"), (EXPIRES, "-1")], EXPIRES),
            (vec![(USER, "a"), (EXPIRES, "soon")], EXPIRES),
        ] {
            let error = read(&headers).unwrap_err();
            assert!(error.contains(&format!("`{header}`")), "{headers:?}: {error}");
        }
        assert!(read(&[(USER, &"x".repeat(129))]).is_err());
        // A time beyond all calendars is none that comes.
        let late = read(&[(USER, "a"), (EXPIRES, &u64::MAX.to_string())]).unwrap();
        assert_eq!(late.expires(), None);
    }
}
