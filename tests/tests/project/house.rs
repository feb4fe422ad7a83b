//! The house: what imports what. The floors of each crate stand in ARCHITECTURE.md, the lowest first.
//!
//! An arrow goes from a file to the file of every module that it names, in `use` lines and in paths,
//! macros included; tests (`cfg(test)`) may import what they like. Circles of folders are looked for among
//! what stands in one folder: the files and folders in `kkt`, each folder with all that is in it.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use proc_macro2::{Delimiter, Group, TokenStream, TokenTree};

/// A module by its names, the root without one: `["kkt", "loops"]`.
type Module = Vec<String>;
/// Who imports whom.
type Graph = BTreeMap<String, BTreeSet<String>>;
type Circle = Graph;

#[test]
fn no_arrow_goes_up_and_none_in_a_circle() {
    let mut faults = String::new();
    for (root, floors) in floors() {
        let house = House::read(&root);
        house.check_floors(&floors, &mut faults);
        let files = house.graph(|module| Some(module.join("::")));
        for circle in circles(&files).iter().filter(|circle| circle.len() > 2) {
            let _ = writeln!(faults, "{root}: files in a circle: {circle:#?}");
        }
        for folder in &house.folders {
            // Files of the folder, and folders in it with a slash at the end.
            let rooms = house.graph(|module| house.room(folder, module));
            let has_folder = |circle: &&Circle| circle.keys().any(|room| room.ends_with('/'));
            for circle in circles(&rooms).iter().filter(has_folder) {
                let _ = writeln!(faults, "{root}: folders in a circle: {circle:#?}");
            }
        }
    }
    assert!(faults.is_empty(), "\n{faults}");
}

#[test]
fn the_core_of_the_server_knows_no_wire() {
    let house = House::read("server/src");
    let wire = ["tonic", "prost", "v1"];
    let mut faults = String::new();
    for (module, names) in &house.idents {
        if module.first().is_some_and(|first| first == "core") {
            for name in names.iter().filter(|name| wire.contains(&name.as_str())) {
                let _ = writeln!(faults, "{} names {name}", module.join("::"));
            }
        }
    }
    assert!(faults.is_empty(), "\n{faults}");
}

#[test]
fn no_test_is_left_out_of_its_program() {
    let mut faults = String::new();
    let mut files = 0;
    let programs = std::fs::read_dir(workspace().join("tests/tests")).unwrap();
    let programs = programs.map(|entry| entry.unwrap().path());
    let mechanics = ["models/tests", "models/control/tests"].map(|path| workspace().join(path));
    for tests in mechanics.into_iter().chain(programs) {
        let main = std::fs::read_to_string(tests.join("main.rs")).unwrap();
        for entry in std::fs::read_dir(&tests).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_stem().unwrap().to_str().unwrap();
            if path.extension().is_some_and(|end| end == "rs") && name != "main" {
                files += 1;
                if !main.lines().any(|line| line == format!("mod {name};")) {
                    let _ = writeln!(faults, "{} is not in main.rs", path.display());
                }
            }
        }
    }
    assert!(faults.is_empty() && files > 80, "{files} files\n{faults}");
}

#[test]
fn arrows_are_seen_wherever_they_hide() {
    let sources = [
        ("", "mod a; mod b; mod c; mod d;"),
        ("a", "use crate::{b::{self, Thing}, c::*}; #[cfg(test)] mod tests { use crate::d; }"),
        ("b", "many! { fn f() { super::c::g() } } mod inner { use super::super::d::Thing; }"),
        ("c", "//! crate::a\n/// [`crate::a`]\npub(in crate::a) const TEXT: &str = \"crate::a\";"),
        ("d", "pub mod e; pub use e::Thing; fn f() -> Option<crate::a::Thing> { None }"),
        ("d::e", "pub struct Thing;"),
    ];
    let sources = sources.map(|(module, text)| {
        let module =
            module.split("::").filter(|name| !name.is_empty()).map(str::to_owned).collect();
        (module, text.to_owned())
    });
    let house = House::new(sources.into_iter().collect());
    let arrows: Vec<_> = house
        .graph(|module| Some(module.join("::")))
        .into_iter()
        .flat_map(|(from, to)| to.into_iter().map(move |to| format!("{from} > {to}")))
        .collect();
    assert_eq!(arrows, ["a > b", "a > c", "b > c", "b > d", "d > a", "d > d::e"]);
}

/// The floors that ARCHITECTURE.md shows in its block `floors`: a source folder, and what is in it, the
/// lowest first.
fn floors() -> Vec<(String, Vec<String>)> {
    let text = std::fs::read_to_string(workspace().join("ARCHITECTURE.md")).expect("a file");
    let block = text.split("```floors\n").nth(1).and_then(|rest| rest.split("```").next());
    let mut floors: Vec<(String, Vec<String>)> = Vec::new();
    for line in block.expect("ARCHITECTURE.md shows the floors").lines() {
        if !line.starts_with(' ') {
            floors.push((line.trim_end_matches(':').to_owned(), Vec::new()));
        } else if let Some((_, floors)) = floors.last_mut() {
            floors.extend(line.split_whitespace().map(str::to_owned));
        }
    }
    let roots: Vec<_> = floors.iter().map(|(root, _)| root.as_str()).collect();
    assert_eq!(
        roots,
        [
            "proto/src",
            "models/math/src",
            "models/scene/src",
            "models/src",
            "models/control/src",
            "models/expect/src",
            "models/import/src",
            "server/src",
            "client/src",
            "client/src/bin/plantctl",
            "client/fmi/src"
        ]
    );
    floors
}

fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The files of a crate, and the arrows between them.
struct House {
    modules: BTreeSet<Module>,
    /// Modules with children.
    folders: BTreeSet<Module>,
    arrows: BTreeSet<(Module, Module)>,
    idents: BTreeMap<Module, BTreeSet<String>>,
}

impl House {
    fn read(root: &str) -> Self {
        let mut sources = BTreeMap::new();
        collect(&workspace().join(root), &mut Vec::new(), &mut sources);
        assert!(sources.len() > 2, "{root} has files");
        Self::new(sources)
    }

    fn new(sources: BTreeMap<Module, String>) -> Self {
        let mut reader = Reader { modules: sources.keys().cloned().collect(), ..Reader::default() };
        for (module, text) in &sources {
            reader.file.clone_from(module);
            let tokens = text.parse().unwrap_or_else(|error| panic!("{module:?}: {error}"));
            reader.read(tokens, module);
        }
        let Reader { mut modules, mut arrows, mut idents, tests, .. } = reader;
        let is_test = |module: &Module| tests.iter().any(|test| module.starts_with(test));
        modules.retain(|module| !is_test(module));
        arrows.retain(|(from, to)| from != to && !is_test(from));
        idents.retain(|module, _| !is_test(module));
        let inside = modules.iter().filter(|module| !module.is_empty());
        let folders = inside.map(|module| module[..module.len() - 1].to_vec()).collect();
        Self { modules, folders, arrows, idents }
    }

    /// The part of a folder that a module belongs to.
    fn room(&self, folder: &Module, module: &Module) -> Option<String> {
        let room = module.get(..=folder.len()).filter(|room| room.starts_with(folder))?;
        let slash = if self.folders.contains(room) { "/" } else { "" };
        Some(format!("{}{slash}", room.join("/")))
    }

    /// The arrows between nodes that modules belong to.
    fn graph(&self, node: impl Fn(&Module) -> Option<String>) -> Graph {
        let mut graph = Graph::new();
        for (from, to) in &self.arrows {
            if let (Some(from), Some(to)) = (node(from), node(to))
                && from != to
            {
                graph.entry(from).or_default().insert(to);
            }
        }
        graph
    }

    fn check_floors(&self, floors: &[String], faults: &mut String) {
        let floor = |module: &Module| {
            let module = if module.is_empty() { "lib".to_owned() } else { module.join("/") };
            let holds = |floor: &str| {
                module
                    .strip_prefix(floor)
                    .is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
            };
            let found = (0..floors.len()).filter(|&i| holds(&floors[i]));
            found.max_by_key(|&i| floors[i].len())
        };
        for module in self.modules.iter().filter(|module| floor(module).is_none()) {
            let _ = writeln!(faults, "{} is on no floor", module.join("/"));
        }
        for (from, to) in &self.arrows {
            if floor(from) < floor(to) {
                let _ = writeln!(faults, "{} imports {}, above it", from.join("::"), to.join("::"));
            }
        }
    }
}

/// Nodes that can be reached from each other, with the arrows among them.
fn circles(graph: &Graph) -> BTreeSet<Circle> {
    let reached = |from| {
        let (mut seen, mut open) = (BTreeSet::new(), vec![from]);
        while let Some(node) = open.pop() {
            open.extend(graph.get(node).into_iter().flatten().filter(|next| seen.insert(*next)));
        }
        seen
    };
    let reach: BTreeMap<_, _> = graph.keys().map(|node| (node, reached(node))).collect();
    let is_on_circle = |node: &&String| reach[*node].contains(*node);
    graph
        .keys()
        .filter(is_on_circle)
        .map(|node| {
            let on_circle = |to: &&String| reach.get(*to).is_some_and(|back| back.contains(node));
            let nodes = reach[node].iter().copied().filter(on_circle);
            let arrows = |from: &String| graph[from].iter().filter(on_circle).cloned().collect();
            nodes.map(|from| (from.clone(), arrows(from))).collect()
        })
        .collect()
}

/// Rust files below a folder, by module; other programs (`bin`) have houses of their own.
fn collect(folder: &Path, module: &mut Module, sources: &mut BTreeMap<Module, String>) {
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        let name = path.file_stem().and_then(|stem| stem.to_str()).expect("UTF-8").to_owned();
        let is_own = matches!(name.as_str(), "mod" | "lib" | "main") && path.is_file();
        module.push(name.clone());
        if path.is_dir() && name != "bin" {
            collect(&path, module, sources);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let known = if is_own { &module[..module.len() - 1] } else { &module[..] };
            let text = std::fs::read_to_string(&path).expect("a file");
            // A library and a program of one crate share a root.
            sources.entry(known.to_vec()).or_default().push_str(&text);
        }
        module.pop();
    }
}

/// What tokens name.
#[derive(Default)]
struct Reader {
    modules: BTreeSet<Module>,
    arrows: BTreeSet<(Module, Module)>,
    idents: BTreeMap<Module, BTreeSet<String>>,
    /// Modules that exist in tests only.
    tests: BTreeSet<Module>,
    /// The file that is read.
    file: Module,
}

impl Reader {
    /// Reads tokens within a module, which may be a part of the file.
    fn read(&mut self, tokens: TokenStream, module: &Module) {
        let tokens: Vec<_> = tokens.into_iter().collect();
        let mut at = 0;
        while let Some(token) = tokens.get(at) {
            at += 1;
            match token {
                TokenTree::Punct(punct)
                    if punct.as_char() == '#' && is_for_tests(tokens.get(at)) =>
                {
                    at = self.skip_item(&tokens, at + 1, module);
                }
                TokenTree::Ident(ident) if ident == "pub" => {
                    let is_scope = group(tokens.get(at), Delimiter::Parenthesis).is_some();
                    at += usize::from(is_scope);
                }
                TokenTree::Ident(ident) if ident == "mod" => {
                    if let (Some(name), Some(body)) =
                        (ident_of(tokens.get(at)), group(tokens.get(at + 1), Delimiter::Brace))
                    {
                        let inner = [module.as_slice(), &[name]].concat();
                        self.read(body.stream(), &inner);
                        at += 2;
                    }
                }
                TokenTree::Ident(_) => at = self.path(&tokens, at - 1, module, None),
                TokenTree::Group(inner) => self.read(inner.stream(), module),
                _ => {}
            }
        }
    }

    /// Reads a path, or a tree of paths with what stands before it; returns where it ends.
    fn path(
        &mut self,
        tokens: &[TokenTree],
        mut at: usize,
        module: &Module,
        before: Option<&Module>,
    ) -> usize {
        let mut path = before.cloned();
        // A name alone is a variable or a thing of this file.
        let mut names = usize::from(path.is_some());
        while let Some(token) = tokens.get(at) {
            match token {
                TokenTree::Ident(ident) => {
                    let name = ident.to_string();
                    self.idents.entry(self.file.clone()).or_default().insert(name.clone());
                    path = Some(joined(path, name, module));
                    names += 1;
                }
                TokenTree::Group(group) if group.delimiter() == Delimiter::Brace => {
                    let inner: Vec<_> = group.stream().into_iter().collect();
                    for tree in inner.split(|token| is_punct(Some(token), ',')) {
                        self.path(tree, 0, module, path.as_ref());
                    }
                    return at + 1;
                }
                _ => break,
            }
            at += 1;
            if !(is_punct(tokens.get(at), ':') && is_punct(tokens.get(at + 1), ':')) {
                break;
            }
            at += 2;
        }
        if let Some(path) = path {
            let known = (0..=path.len()).rev().map(|len| &path[..len]);
            let target = known.map(<[String]>::to_vec).find(|module| self.modules.contains(module));
            if let (true, Some(target)) = (names > 1, target) {
                self.arrows.insert((self.file.clone(), target));
            }
        }
        at
    }

    /// Where the item ends that an attribute speaks of.
    fn skip_item(&mut self, tokens: &[TokenTree], mut at: usize, module: &Module) -> usize {
        while let Some(token) = tokens.get(at) {
            let name = ident_of(tokens.get(at + 1));
            if let (true, Some(name)) = (ident_of(Some(token)).is_some_and(|i| i == "mod"), name) {
                self.tests.insert([module.as_slice(), &[name]].concat());
            }
            at += 1;
            let is_body = group(Some(token), Delimiter::Brace).is_some();
            if is_body || is_punct(Some(token), ';') {
                break;
            }
        }
        at
    }
}

/// A path with one more name; without a path it begins here.
fn joined(path: Option<Module>, name: String, module: &Module) -> Module {
    match (path, name.as_str()) {
        (None, "crate") => Vec::new(),
        (None, "self") => module.clone(),
        (None, "super") => module[..module.len().saturating_sub(1)].to_vec(),
        (None, _) => [module.as_slice(), &[name]].concat(),
        (Some(path), "self") => path,
        (Some(path), "super") => path[..path.len().saturating_sub(1)].to_vec(),
        (Some(mut path), _) => {
            path.push(name);
            path
        }
    }
}

fn is_for_tests(attribute: Option<&TokenTree>) -> bool {
    group(attribute, Delimiter::Bracket)
        .is_some_and(|group| group.stream().to_string().replace(' ', "") == "cfg(test)")
}

fn group(token: Option<&TokenTree>, delimiter: Delimiter) -> Option<&Group> {
    match token {
        Some(TokenTree::Group(group)) if group.delimiter() == delimiter => Some(group),
        _ => None,
    }
}

fn ident_of(token: Option<&TokenTree>) -> Option<String> {
    match token {
        Some(TokenTree::Ident(ident)) => Some(ident.to_string()),
        _ => None,
    }
}

fn is_punct(token: Option<&TokenTree>, character: char) -> bool {
    matches!(token, Some(TokenTree::Punct(punct)) if punct.as_char() == character)
}
