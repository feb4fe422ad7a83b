//! Meshes of a scene, found on this machine and sent to the server.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::Result;
use plantd_client::{Client, v1};
use plantd_import::meshes::references;
use v1::drawn_shape::Shape;
use v1::get_drawing_request::Of;

/// Where meshes are looked for.
pub(crate) struct Meshes {
    folder: PathBuf,
    packages: BTreeMap<String, String>,
}

impl Meshes {
    /// Beside a file in a folder, and in the folders of packages by name.
    pub(crate) fn new(folder: &Path, packages: Vec<(String, String)>) -> Self {
        Self { folder: folder.to_owned(), packages: packages.into_iter().collect() }
    }

    /// Sends the meshes that a model names and the server has not, with what they refer to. Says on standard error
    /// how many, and which were not found or not taken: without them the model is as good.
    pub(crate) async fn send(&self, client: &Client, model: &str) -> Result<()> {
        let of = Some(Of::Model(model.to_owned()));
        let drawing = client.get_drawing(v1::GetDrawingRequest { of }).await?.drawing;
        let (mut waiting, mut seen) = (wanted(&drawing.unwrap_or_default()), BTreeSet::new());
        let mut sent = 0;
        while let Some(file) = waiting.pop() {
            if !seen.insert(file.clone()) {
                continue;
            }
            let places = self.places(&file);
            let found = places.iter().find_map(|place| std::fs::read(place).ok());
            let Some(data) = found else {
                let looked: Vec<_> = places.iter().map(|p| p.display().to_string()).collect();
                eprintln!("mesh `{file}` was not found; it is not at {}", looked.join(" or "));
                continue;
            };
            waiting.extend(references(&file, &data));
            let request = v1::PutModelFileRequest { model: model.to_owned(), file, data };
            let name = request.file.clone();
            match client.put_model_file(request).await {
                Ok(_) => sent += 1,
                Err(error) => eprintln!("mesh `{name}` was not taken: {error}"),
            }
        }
        if sent > 0 {
            eprintln!("{sent} files of meshes sent");
        }
        Ok(())
    }

    /// Where a file may be that a scene names.
    fn places(&self, file: &str) -> Vec<PathBuf> {
        let package =
            ["package://", "model://"].iter().find_map(|scheme| file.strip_prefix(scheme));
        let Some((name, path)) = package.and_then(|rest| rest.split_once('/')) else {
            let path = file.strip_prefix("file://").unwrap_or(file);
            return vec![self.folder.join(path)];
        };
        if let Some(folder) = self.packages.get(name) {
            return vec![Path::new(folder).join(path)];
        }
        // Where robots are kept, the file stands in its package, or beside it.
        let folder = std::path::absolute(&self.folder).unwrap_or_else(|_| self.folder.clone());
        let around = folder.ancestors();
        let here = around.filter(|f| f.file_name().is_some_and(|n| n == name));
        let here = here.map(|package| package.join(path));
        let beside = around.map(|folder| folder.join(name)).filter(|package| package.is_dir());
        let mut places: Vec<PathBuf> = here.chain(beside.map(|p| p.join(path))).collect();
        if places.is_empty() {
            places.push(folder.join(name).join(path));
        }
        places
    }
}

/// Meshes that the server has not.
fn wanted(drawing: &v1::Drawing) -> Vec<String> {
    let shapes = drawing.frames.iter().flat_map(|frame| &frame.shapes);
    let meshes = shapes.filter_map(|shape| match &shape.shape {
        Some(Shape::Mesh(mesh)) if mesh.url.is_empty() => Some(mesh.file.clone()),
        _ => None,
    });
    meshes.collect::<BTreeSet<_>>().into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packages_are_around_the_file_or_where_they_are_said_to_be() {
        let root = std::env::temp_dir().join(format!("plantctl-meshes-{}", std::process::id()));
        let robots = root.join("panda/robots");
        std::fs::create_dir_all(&robots).unwrap();
        std::fs::create_dir_all(root.join("hand")).unwrap();
        let meshes = Meshes::new(&robots, vec![("tool".to_owned(), "/opt/tool".to_owned())]);
        assert_eq!(meshes.places("a/b.stl"), [robots.join("a/b.stl")]);
        let of_panda = meshes.places("package://panda/meshes/a.stl");
        assert!(of_panda.contains(&root.join("panda/meshes/a.stl")), "{of_panda:?}");
        let of_hand = meshes.places("package://hand/a.stl");
        assert_eq!(of_hand, [root.join("hand/a.stl")]);
        assert_eq!(meshes.places("package://tool/a.stl"), [PathBuf::from("/opt/tool/a.stl")]);
        assert_eq!(meshes.places("package://none/a.stl").len(), 1);
        std::fs::remove_dir_all(root).unwrap();
    }
}
