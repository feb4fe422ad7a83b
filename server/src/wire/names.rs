//! By which names the server may be called, and by which pages.
//!
//! Also where nobody is asked who they are, a browser lets any page send requests to servers that its machine
//! reaches. So the server looks at two things that a page cannot choose: `Origin`, where the page
//! comes from, which browsers add to each request but plain GETs; and the host (`Host`, or
//! `:authority` of HTTP/2), the name under which the server was looked up. An attacker's own name
//! can be made to lead here (DNS rebinding), and then page and server have the same origin; but not
//! one that the server knows.
//!
//! | request | served if |
//! | --- | --- |
//! | with `Origin` | the origin is listed, or is the server's own under a host that it knows |
//! | without | it knows the host; or listens beyond the loopback interface, where programs call it by names that it cannot know. A page's gRPC-Web call is never of this kind. |
//! | without, for metrics and the page | it knows the host: a plain GET is what a page can send without `Origin` |
//! | over a unix-domain socket | as above, with any host: no browser gets there, and programs send many |
//!
//! It knows `localhost`, names under it, IP addresses, and `allowed_hosts`. No CORS header is sent.

use std::net::IpAddr;

/// The names.
#[derive(Clone, Debug, Default)]
pub struct Names {
    /// Further host names.
    pub hosts: Vec<String>,
    /// Origins of pages that may call: `https://panel.example`.
    pub origins: Vec<String>,
    /// Programs may call by any host name.
    pub any_host: bool,
}

/// Why a request is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Foreign {
    /// The host.
    #[error("the server does not go by the name `{0}`; list it in `allowed_hosts` if it does")]
    Host(String),
    /// The page.
    #[error("pages of `{0}` may not use this server; list it in `allowed_origins` if they may")]
    Origin(String),
}

impl Names {
    /// Refuses a request by its hosts (from `:authority` and `Host`) and its origins.
    pub fn check<'a, H, O>(
        &self,
        hosts: impl Fn() -> H,
        origins: impl Fn() -> O,
    ) -> Result<(), Foreign>
    where
        H: Iterator<Item = &'a str>,
        O: Iterator<Item = &'a str>,
    {
        let from_page = origins().next().is_some();
        if let Some(host) = hosts().find(|host| !self.knows(host))
            && (from_page || !self.any_host)
        {
            return Err(Foreign::Host(host.to_owned()));
        }
        match origins().find(|origin| !self.allows(origin, hosts())) {
            Some(origin) => Err(Foreign::Origin(origin.to_owned())),
            None => Ok(()),
        }
    }

    /// These names, for a service that pages could call without saying so.
    pub fn strict(&self) -> Self {
        Self { any_host: false, ..self.clone() }
    }

    fn knows(&self, host: &str) -> bool {
        let Some(name) = name(host) else { return false };
        is_local(name)
            || name.parse::<IpAddr>().is_ok()
            || self.hosts.iter().any(|host| host.eq_ignore_ascii_case(name))
    }

    /// `hosts` are known.
    fn allows<'a>(&self, origin: &str, mut hosts: impl Iterator<Item = &'a str>) -> bool {
        let own = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
        self.origins.iter().any(|listed| listed.eq_ignore_ascii_case(origin))
            || own.is_some_and(|own| hosts.any(|host| host.eq_ignore_ascii_case(own)))
    }
}

/// The host of `host:port`, without brackets and a final dot; none if it is neither.
fn name(authority: &str) -> Option<&str> {
    let (name, port) = match authority.strip_prefix('[') {
        Some(rest) => rest.split_once(']')?,
        None => authority.split_at(authority.find(':').unwrap_or(authority.len())),
    };
    let port = port.strip_prefix(':').unwrap_or(port);
    let is_number = port.bytes().all(|digit| digit.is_ascii_digit());
    (is_number && !name.contains('@')).then(|| name.strip_suffix('.').unwrap_or(name))
}

fn is_local(name: &str) -> bool {
    let last = name.rsplit('.').next().unwrap_or(name);
    last.eq_ignore_ascii_case("localhost")
}

/// Whether this is a host name as [`Names::hosts`] has them: without a port.
pub fn is_host_name(text: &str) -> bool {
    !text.is_empty()
        && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte))
}

/// Whether clients can be told that this is the address of a server: a URL without a path, or a socket.
pub fn is_address(text: &str) -> bool {
    if text.len() > 1024 || text.bytes().any(|byte| !byte.is_ascii_graphic()) {
        return false;
    }
    match text.split_once(':') {
        Some(("unix", path)) => path.starts_with('/'),
        Some(("http" | "https", rest)) => rest.strip_prefix("//").is_some_and(|host| {
            !host.contains(['/', '@', '?', '#']) && name(host).is_some_and(|name| !name.is_empty())
        }),
        _ => false,
    }
}

/// The host of an address, if it is a name.
pub fn host_of(address: &str) -> Option<&str> {
    let (_, authority) = address.split_once("://")?;
    name(authority).filter(|name| is_host_name(name))
}

/// Whether this is an origin as browsers send it: scheme, host, port if it is not the scheme's own.
pub fn is_origin(text: &str) -> bool {
    text.split_once("://").is_some_and(|(scheme, host)| {
        let is_word = scheme.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-');
        !scheme.is_empty()
            && is_word
            && !host.contains('/')
            && name(host).is_some_and(|name| !name.is_empty())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn served(names: &Names, host: &str, origin: &str) -> bool {
        let origin = Some(origin).filter(|origin| !origin.is_empty());
        names.check(|| [host].into_iter(), || origin.into_iter()).is_ok()
    }

    #[test]
    fn programs_call_this_machine_by_its_names() {
        let names = Names::default();
        for host in ["localhost", "LocalHost:50051", "a.localhost:1", "127.0.0.1:50051", "10.0.0.1"]
            .into_iter()
            .chain(["[::1]:50051", "[::]", "localhost."])
        {
            assert!(served(&names, host, ""), "{host}");
        }
        for host in ["evil.example", "localhost.evil.example:50051", "127.0.0.1.evil.example"]
            .into_iter()
            .chain(["user@localhost", "127.0.0.1:x", "[::1", "notlocalhost", ":50051", ""])
        {
            assert!(!served(&names, host, ""), "{host}");
        }
    }

    #[test]
    fn beyond_loopback_programs_call_by_any_name_and_pages_do_not() {
        let names = Names { any_host: true, ..Names::default() };
        assert!(served(&names, "plants.lab:50051", ""));
        assert!(!served(&names, "plants.lab:50051", "http://plants.lab:50051"));
        assert!(!served(&names.strict(), "plants.lab:50051", ""));
    }

    #[test]
    fn pages_of_the_server_itself_and_listed_ones_may_call() {
        let names = Names {
            hosts: vec!["plants.lab".to_owned()],
            origins: vec!["https://panel.example".to_owned()],
            any_host: false,
        };
        assert!(served(&names, "plants.lab:50051", ""));
        assert!(served(&names, "plants.lab:50051", "http://plants.lab:50051"));
        assert!(served(&names, "127.0.0.1:50051", "http://127.0.0.1:50051"));
        assert!(served(&names, "localhost:50051", "https://panel.example"));
        for origin in ["https://evil.example", "http://localhost:3000", "null", "http://localhost"]
            .into_iter()
            .chain(["https://panel.example.evil", "http://panel.example", "localhost:50051"])
        {
            assert!(!served(&names, "localhost:50051", origin), "{origin}");
        }
        assert!(!served(&names, "evil.example", "https://panel.example"));
    }

    #[test]
    fn names_of_the_configuration_are_checked() {
        assert!(is_host_name("plants.lab") && is_host_name("a_b"));
        assert!(!is_host_name("plants.lab:1") && !is_host_name("http://a") && !is_host_name(""));
        assert!(is_origin("https://panel.example") && is_origin("http://localhost:3000"));
        assert!(is_origin("chrome-extension://abc"));
        assert!(!is_origin("panel.example") && !is_origin("http://a/") && !is_origin("null"));
        assert!(!is_origin("http://") && !is_origin("://a"));
        for good in ["http://plants.lab:50051", "https://[::1]:1", "unix:/run/plantd.sock"] {
            assert!(is_address(good), "{good}");
        }
        for bad in
            ["plants.lab", "http://", "http://a/b", "http://u@a", "ftp://a", "unix:a", "http://a b"]
        {
            assert!(!is_address(bad), "{bad}");
        }
        assert_eq!(host_of("https://plants.lab:50051"), Some("plants.lab"));
        assert_eq!((host_of("unix:/run/plantd.sock"), host_of("http://[::1]:1")), (None, None));
    }
}
