//! Default classes, and what an element says together with its class.

use std::collections::BTreeMap;

use roxmltree::Node;

use crate::document::Reader;

/// Top-level `default` elements that are read at most.
const SECTIONS_MAX: usize = 64;

/// The outermost class of the model itself.
pub(super) const MAIN: usize = 0;

/// What a range can be switched by.
pub(super) const SWITCH: [&str; 3] = ["false", "true", "auto"];

/// Whether a range counts: by its switch, or else where it is given.
pub(super) fn is_on(switch: Option<usize>, is_automatic: bool, range: [f64; 2]) -> bool {
    match switch {
        Some(0) => false,
        Some(1) => true,
        _ => is_automatic && range != [0.0; 2],
    }
}

/// Classes, parents before children; the first is `main`.
pub(super) struct Classes<'a> {
    classes: Vec<Class<'a>>,
    names: BTreeMap<&'a str, usize>,
    /// Outermost classes of the models that there are.
    roots: Vec<usize>,
}

#[derive(Default)]
struct Class<'a> {
    parent: Option<usize>,
    /// Elements that say what its members are unless they say otherwise.
    settings: Vec<Node<'a, 'a>>,
}

impl<'a> Classes<'a> {
    pub(super) fn read(reader: &mut Reader<'_>, root: Node<'a, 'a>) -> Self {
        let models = reader.models().len();
        let classes = (0..models).map(|_| Class::default()).collect();
        let roots = (0..models).collect();
        let mut all = Self { classes, names: BTreeMap::from([("main", MAIN)]), roots };
        let sections = root.children().filter(|node| node.has_tag_name("default"));
        for (i, section) in sections.enumerate() {
            if i == SECTIONS_MAX * models {
                reader.fail(section, format!("more than {SECTIONS_MAX} sections `default`"));
                break;
            }
            let model = reader.model_of(section);
            match section.attribute("class") {
                // What attaches it has put a prefix before.
                Some(name) if model != 0 => {
                    all.names.insert(name, model);
                }
                Some(name) if name != "main" => {
                    reader.fail(section, "the class of the outermost `default` is `main`");
                }
                _ => {}
            }
            all.fill(reader, section, model);
        }
        all
    }

    /// Takes what is in a `default` into its class, then makes the classes within.
    fn fill(&mut self, reader: &mut Reader<'_>, section: Node<'a, 'a>, class: usize) {
        let mut seen = Vec::new();
        for node in section.children().filter(Node::is_element) {
            let tag = node.tag_name().name();
            if tag == "default" {
                let name = reader.required(node, "class");
                let inner = self.classes.len();
                self.classes.push(Class { parent: Some(class), settings: Vec::new() });
                if self.names.insert(name, inner).is_some() {
                    reader.fail(node, format!("there are two classes `{name}`"));
                }
                self.fill(reader, node, inner);
            } else if seen.contains(&tag) {
                reader.fail(node, format!("a second `{tag}` in `default`; there may be one"));
            } else {
                seen.push(tag);
                self.classes[class].settings.push(node);
            }
        }
    }

    /// The outermost class for an element.
    pub(super) fn root(&self, reader: &Reader<'_>, node: Node<'_, '_>) -> usize {
        self.roots[reader.model_of(node)]
    }

    /// The class that an attribute names.
    pub(super) fn named(
        &self,
        reader: &mut Reader<'_>,
        node: Node<'_, '_>,
        attribute: &str,
    ) -> Option<usize> {
        let name = node.attribute(attribute)?;
        let found = self.names.get(name).copied();
        if found.is_none() {
            reader.fail(node, format!("there is no class `{name}`"));
        }
        found
    }

    /// What an element says: its own attributes, those of `default` elements of the given name in its class,
    /// then in the parents of that.
    pub(super) fn settings(
        &self,
        reader: &mut Reader<'_>,
        node: Node<'a, 'a>,
        around: usize,
        tag: &str,
    ) -> Settings<'a> {
        let class = self.named(reader, node, "class").unwrap_or(around);
        let mut nodes = self.chain(class, |name| name == tag);
        nodes.push(node);
        Settings { nodes }
    }

    /// Elements in the `default`s of a class and its parents, these first, whose names are taken.
    pub(super) fn chain(&self, class: usize, takes: impl Fn(&str) -> bool) -> Vec<Node<'a, 'a>> {
        let up = std::iter::successors(Some(class), |class| self.classes[*class].parent);
        let takes = |node: &&Node<'a, 'a>| takes(node.tag_name().name());
        let mut nodes: Vec<_> = up
            .flat_map(|class| self.classes[class].settings.iter().rev().filter(takes))
            .copied()
            .collect();
        nodes.reverse();
        nodes
    }
}

/// An element with what its class says: the nearest that has an attribute counts.
pub(super) struct Settings<'a> {
    /// The element itself comes last.
    nodes: Vec<Node<'a, 'a>>,
}

impl<'a> Settings<'a> {
    /// An element that has no class.
    pub(super) fn alone(node: Node<'a, 'a>) -> Self {
        Self { nodes: vec![node] }
    }

    /// The element itself.
    pub(super) fn node(&self) -> Node<'a, 'a> {
        self.nodes[self.nodes.len() - 1]
    }

    fn find(&self, name: &str) -> Option<(Node<'a, 'a>, &'a str)> {
        self.nodes.iter().rev().find_map(|node| Some((*node, node.attribute(name)?)))
    }

    pub(super) fn text(&self, name: &str) -> Option<&'a str> {
        self.find(name).map(|(_, text)| text)
    }

    /// The nearest of all elements that has one of some attributes, and which.
    pub(super) fn one_of<'n>(
        &self,
        reader: &mut Reader<'_>,
        names: &[&'n str],
    ) -> Option<(Node<'a, 'a>, &'n str, &'a str)> {
        self.nodes.iter().rev().find_map(|node| {
            let mut there = names.iter().filter(|name| node.has_attribute(**name));
            let first = there.next()?;
            if let Some(second) = there.next() {
                reader.fail(*node, format!("`{first}` and `{second}`; one of them is allowed"));
            }
            Some((*node, *first, node.attribute(*first)?))
        })
    }

    pub(super) fn numbers<const N: usize>(
        &self,
        reader: &mut Reader<'_>,
        name: &str,
    ) -> Option<[f64; N]> {
        self.find(name).map(|(node, text)| reader.numbers(node, name, text))
    }

    pub(super) fn number(&self, reader: &mut Reader<'_>, name: &str) -> Option<f64> {
        self.numbers::<1>(reader, name).map(|[number]| number)
    }

    /// Numbers of which the last may be left out; those are the ones of the class, or else zero.
    pub(super) fn first_numbers<const N: usize>(
        &self,
        reader: &mut Reader<'_>,
        name: &str,
    ) -> [f64; N] {
        let mut numbers = [0.0; N];
        for node in &self.nodes {
            if let Some(text) = node.attribute(name) {
                reader.first_numbers(*node, name, text, &mut numbers);
            }
        }
        numbers
    }

    /// A number that is not negative, or zero.
    pub(super) fn amount(&self, reader: &mut Reader<'_>, name: &str) -> f64 {
        let Some(number) = self.number(reader, name) else { return 0.0 };
        if number < 0.0 {
            let of = self.node().tag_name().name();
            reader
                .fail(self.node(), format!("`{name}` of `{of}` is {number}; must not be negative"));
        }
        number
    }

    /// The place of a keyword among those that are allowed, if it is given.
    pub(super) fn keyword(
        &self,
        reader: &mut Reader<'_>,
        name: &str,
        allowed: &[&str],
    ) -> Option<usize> {
        self.find(name).map(|(node, text)| reader.keyword(node, name, text, allowed))
    }

    pub(super) fn is_true(&self, reader: &mut Reader<'_>, name: &str) -> bool {
        self.keyword(reader, name, &["false", "true"]) == Some(1)
    }

    /// A range that counts: where a switch says so, or says `auto` and the range is there.
    pub(super) fn range(
        &self,
        reader: &mut Reader<'_>,
        name: &str,
        switch: &str,
        is_automatic: bool,
    ) -> Option<[f64; 2]> {
        let range = self.numbers::<2>(reader, name).unwrap_or_default();
        let counts = is_on(self.keyword(reader, switch, &SWITCH), is_automatic, range);
        if counts && range[0] >= range[1] {
            let of = self.node().tag_name().name();
            let [low, high] = range;
            reader
                .fail(self.node(), format!("`{name}` of `{of}` is {low} to {high}; must increase"));
        }
        counts.then_some(range)
    }
}
