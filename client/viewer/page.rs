//! The page that shows plants, as its servers hand it out: the files of `dist`, and the headers that go with them.

/// A file of the page.
#[derive(Debug)]
pub struct Part {
    /// Its path.
    pub path: &'static str,
    /// Content type.
    pub kind: &'static str,
    /// Its bytes.
    pub bytes: &'static [u8],
    /// These are compressed with gzip.
    pub is_compressed: bool,
}

macro_rules! dist {
    ($file:literal) => {
        include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/dist/", $file))
    };
}

/// What the page is made of.
pub const PARTS: [Part; 3] = [
    Part {
        path: "/",
        kind: "text/html; charset=utf-8",
        bytes: dist!("index.html"),
        is_compressed: false,
    },
    Part {
        path: "/viewer.js",
        kind: "text/javascript; charset=utf-8",
        bytes: dist!("viewer.js.gz"),
        is_compressed: true,
    },
    Part {
        path: "/viewer.css",
        kind: "text/css; charset=utf-8",
        bytes: dist!("viewer.css"),
        is_compressed: false,
    },
];

/// Content-Security-Policy: the page runs its own script and talks to its own server, and nobody shows it in a frame.
pub const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
    connect-src 'self' blob:; img-src 'self' data: blob:; font-src 'self'; form-action 'none'; \
    frame-ancestors 'none'; base-uri 'none'";

/// Headers of all answers, by name: nobody guesses what they are, and no page of another origin gets them as an image
/// or a script.
pub const HEADERS: [(&str, &str); 3] = [
    ("x-content-type-options", "nosniff"),
    ("referrer-policy", "no-referrer"),
    ("cross-origin-resource-policy", "same-origin"),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_script_is_there_compressed() {
        for Part { path, bytes, is_compressed, .. } in PARTS {
            assert_eq!(bytes.starts_with(&[0x1f, 0x8b]), is_compressed, "{path}");
        }
    }
}
