//! Loads the scenes of a directory at the start, with the meshes that lie in it.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, Result, bail, ensure};
use plantd_import::meshes;
use plantd_models::{Model, Scene};

use crate::core::catalog::Catalog;
use crate::core::files::path_of;

/// Loads every scene of a directory as a model under the scene's own name.
pub(crate) fn load(catalog: &Catalog, directory: &Path) -> Result<()> {
    let in_directory = || format!("scenes in {}", directory.display());
    let mut paths = std::fs::read_dir(directory)
        .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>())
        .with_context(in_directory)?;
    paths.retain(|path| path.extension().is_some_and(|kind| kind == "toml" || kind == "json"));
    paths.sort();
    for path in paths {
        load_scene(catalog, directory, &path)
            .with_context(|| format!("scene {}", path.display()))?;
    }
    Ok(())
}

fn load_scene(catalog: &Catalog, directory: &Path, path: &Path) -> Result<()> {
    let text = std::fs::read_to_string(path)?;
    let scene = Scene::from_text(&text)?;
    let model = Model::compile(&scene)?;
    let name = model.scene().name.clone();
    catalog.insert(&name, Arc::new(model))?;
    tracing::info!(model = name, "scene loaded");
    let mut files = meshes::of_scene(&scene);
    while let Some(file) = files.pop() {
        if catalog.files(&name).is_some_and(|files| files.find(&file).is_some()) {
            continue;
        }
        // A mesh shows something and moves nothing: without it the scene is as good.
        match load_file(catalog, &name, directory, &file) {
            Ok(bytes) => files.extend(meshes::references(&file, &bytes)),
            Err(error) => tracing::warn!(model = name, file, "mesh not loaded: {error:#}"),
        }
    }
    Ok(())
}

/// Gives a model a file that lies in the directory, links resolved.
fn load_file(catalog: &Catalog, model: &str, directory: &Path, file: &str) -> Result<Vec<u8>> {
    let path = path_of(file)?;
    let place = inside(directory, &path)?;
    // Not more than may be kept: a file may be of any size.
    let size = std::fs::metadata(&place)?.len();
    catalog.check_file_size(size)?;
    let bytes = std::fs::read(&place)?;
    catalog.put_file(model, file, bytes.clone())?;
    Ok(bytes)
}

/// The file at a path of a directory, unless a link leads out of it.
fn inside(directory: &Path, path: &str) -> Result<PathBuf> {
    let directory = directory.canonicalize()?;
    let place = match directory.join(path).canonicalize() {
        Ok(place) => place,
        Err(error) => bail!("`{path}`: {error}"),
    };
    ensure!(place.starts_with(&directory), "`{path}` leads out of the folder of the scenes");
    ensure!(place.is_file(), "`{path}` is no file");
    Ok(place)
}

#[cfg(test)]
mod tests {
    use prometheus_client::metrics::gauge::Gauge;

    use super::*;
    use crate::core::limits::Limits;

    const SCENE: &str = r#"
format = 1
name = "shown"
gravity = [0.0, 0.0, -9.8]
[[frames]]
name = "arm"
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 1.0, center_of_mass = [0.0, 0.0, -0.5] }
visuals = [
    { shape = { type = "mesh", file = "meshes/arm.obj" } },
    { shape = { type = "mesh", file = "meshes/link.stl" } },
    { shape = { type = "mesh", file = "../secret.stl" } },
    { shape = { type = "mesh", file = "meshes/none.stl" } },
    { shape = { type = "mesh", file = "meshes/large.stl" } },
]
"#;

    #[test]
    fn meshes_come_with_scenes_and_from_nowhere_else() {
        let outside = tempfile::tempdir().unwrap();
        let scenes = outside.path().join("scenes");
        std::fs::create_dir_all(scenes.join("meshes")).unwrap();
        let write = |path: &str, bytes: &[u8]| std::fs::write(scenes.join(path), bytes).unwrap();
        write("shown.toml", SCENE.as_bytes());
        write("meshes/arm.obj", b"mtllib arm.mtl\nv 0 0 0\n");
        write("meshes/arm.mtl", b"newmtl m\nmap_Kd arm.png\nmap_Bump ../../secret.png\n");
        write("meshes/arm.png", b"picture");
        write("meshes/large.stl", &[0; 100]);
        std::fs::write(outside.path().join("secret.stl"), b"secret").unwrap();
        std::fs::write(outside.path().join("secret.png"), b"secret").unwrap();
        std::os::unix::fs::symlink("../../secret.stl", scenes.join("meshes/link.stl")).unwrap();
        let limits = Limits { model_file_bytes: 99, ..Limits::default() };
        let catalog = Catalog::new(&limits, Gauge::default(), Arc::default());
        load(&catalog, &scenes).unwrap();
        let files = catalog.files("shown").unwrap();
        for file in ["meshes/arm.obj", "meshes/arm.mtl", "meshes/arm.png"] {
            assert!(files.get(file).is_some(), "{file}");
        }
        for file in ["meshes/link.stl", "secret.stl", "secret.png", "meshes/none.stl"]
            .into_iter()
            .chain(["../secret.stl", "meshes/large.stl"])
        {
            assert!(files.get(file).is_none(), "{file}");
        }
    }
}
