//! What is done with each element and attribute of a format.

/// How something of a file is treated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Treatment {
    /// It is read; the reader notes where a value cannot be taken exactly.
    Read,
    /// It does not change the motion; why.
    NoEffect(&'static str),
    /// It says what touches what; nothing does.
    Contact,
    /// It changes the motion, or may; what to do.
    Refused(&'static str),
}

/// What becomes of contacts.
pub(crate) const NO_CONTACT: &str =
    "contacts are not simulated; bodies pass through one another and through the floor";

/// Treatments, each with the names that it is for, apart by spaces.
pub(crate) type Treatments = &'static [(Treatment, &'static str)];

/// An element of a format that is read.
#[derive(Debug)]
pub(crate) struct Element {
    pub(crate) name: &'static str,
    pub(crate) attributes: Treatments,
    /// Elements in it that are read too. They may hold their parents: formats nest.
    pub(crate) children: &'static [&'static Element],
    /// Elements in it that are not, with everything in them.
    pub(crate) left_out: Treatments,
}

impl Element {
    /// One whose attributes and children are all read.
    pub(crate) const fn new(
        name: &'static str,
        attributes: Treatments,
        children: &'static [&'static Element],
    ) -> Self {
        Self { name, attributes, children, left_out: &[] }
    }

    /// With elements that are left out.
    pub(crate) const fn without(mut self, left_out: Treatments) -> Self {
        self.left_out = left_out;
        self
    }

    /// What is done with one of its attributes.
    pub(crate) fn attribute(&self, name: &str) -> Option<Treatment> {
        treatment(self.attributes, name)
    }

    /// One of its children that are read.
    pub(crate) fn child(&self, name: &str) -> Option<&'static Element> {
        self.children.iter().copied().find(|child| child.name == name)
    }

    /// What is done with an element in it.
    pub(crate) fn treatment(&self, name: &str) -> Option<Treatment> {
        let read = self.child(name).map(|_| Treatment::Read);
        read.or_else(|| treatment(self.left_out, name))
    }
}

fn treatment(all: Treatments, name: &str) -> Option<Treatment> {
    let knows = |names: &str| names.split_ascii_whitespace().any(|known| known == name);
    all.iter().find(|(_, names)| knows(names)).map(|(treatment, _)| *treatment)
}

/// Tests of a table.
#[cfg(test)]
pub(crate) mod tests {
    use super::{Element, Treatments};

    /// Goes through a list of what a format has: `path/of/elements: attributes`, one element a line, `*` for
    /// an element that is left out with everything in it.
    pub(crate) fn everything_is_treated(root: &'static Element, specified: &str) {
        for line in specified.lines().filter(|line| !line.is_empty()) {
            let (path, attributes) = line.split_once(':').unwrap_or_else(|| panic!("{line}"));
            let mut names = path.split('/').skip(1).peekable();
            let mut element = root;
            while let Some(name) = names.next() {
                let found = element.treatment(name);
                assert!(found.is_some(), "{path}: no `{name}` in `{}`", element.name);
                match element.child(name) {
                    Some(child) => element = child,
                    None => assert!(names.peek().is_none(), "{path}: `{name}` is left out"),
                }
            }
            for name in attributes.split_ascii_whitespace().filter(|name| *name != "*") {
                assert!(element.attribute(name).is_some(), "{path}: no attribute `{name}`");
            }
        }
    }

    /// No name stands in a table twice.
    pub(crate) fn nothing_is_there_twice(root: &'static Element) {
        let (mut open, mut seen) = (vec![root], Vec::<*const Element>::new());
        while let Some(element) = open.pop() {
            if seen.contains(&std::ptr::from_ref(element)) {
                continue;
            }
            seen.push(element);
            let words = |all: Treatments| all.iter().flat_map(|(_, names)| names.split(' '));
            let children = element.children.iter().map(|child| child.name);
            let all = [
                words(element.attributes).collect::<Vec<_>>(),
                children.chain(words(element.left_out)).collect(),
            ];
            for mut names in all {
                names.sort_unstable();
                let count = names.len();
                names.dedup();
                assert_eq!(names.len(), count, "{}", element.name);
            }
            open.extend(element.children);
        }
    }
}
