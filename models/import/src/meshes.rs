//! Files that show a scene: meshes, and what these refer to.

use std::collections::BTreeSet;

use plantd_models::Scene;
use plantd_models::scene::Shape;

/// References of one file that are followed at most.
const REFERENCES_MAX: usize = 1024;

/// Files of the meshes of a scene, each once, as the scene names them.
pub fn of_scene(scene: &Scene) -> Vec<String> {
    let visuals = scene.frames.iter().flat_map(|frame| &frame.visuals);
    let files = visuals.filter_map(|visual| match &visual.shape {
        Shape::Mesh { file, .. } => Some(file.clone()),
        _ => None,
    });
    files.collect::<BTreeSet<_>>().into_iter().collect()
}

/// Files that a file refers to, named as the scene would: materials of an `obj`, pictures of an `mtl` or a `dae`.
/// What other files refer to, and what does not lie near them, is none.
pub fn references(file: &str, bytes: &[u8]) -> Vec<String> {
    let text = String::from_utf8_lossy(bytes);
    let end = file.rsplit('.').next().unwrap_or_default().to_ascii_lowercase();
    let names: BTreeSet<&str> = match end.as_str() {
        "obj" => text
            .lines()
            .filter_map(|line| line.trim().strip_prefix("mtllib "))
            .flat_map(str::split_whitespace)
            .take(REFERENCES_MAX)
            .collect(),
        "mtl" => text
            .lines()
            .map(str::trim)
            .filter(|line| ["map_", "bump ", "disp ", "norm "].iter().any(|k| line.starts_with(k)))
            .filter_map(|line| line.split_whitespace().last())
            .take(REFERENCES_MAX)
            .collect(),
        "dae" => text
            .split("<init_from>")
            .skip(1)
            .filter_map(|rest| Some(rest.split_once('<')?.0.trim()))
            // Others are the names of what is in the file itself.
            .filter(|name| name.contains('.'))
            .take(REFERENCES_MAX)
            .collect(),
        _ => BTreeSet::new(),
    };
    names.into_iter().filter_map(|name| beside(file, name)).collect()
}

/// A path that is relative to a file; none if it is absolute or leads above all that is known.
fn beside(file: &str, name: &str) -> Option<String> {
    let (scheme, path) = match file.find("://") {
        Some(at) => file.split_at(at + "://".len()),
        None => ("", file),
    };
    let name = name.replace('\\', "/");
    if name.starts_with('/') || name.contains(':') {
        return None;
    }
    let mut parts: Vec<&str> = path.split('/').collect();
    parts.pop();
    for part in name.split('/') {
        match part {
            "" | "." => {}
            ".." => match parts.last() {
                Some(&last) if last != ".." => drop(parts.pop()),
                _ => return None,
            },
            part => parts.push(part),
        }
    }
    Some(format!("{scheme}{}", parts.join("/")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_name_others_beside_them() {
        let obj = b"# mtllib no.mtl\nmtllib arm.mtl more.mtl\r\nv 0 0 0\n";
        assert_eq!(references("a/arm.OBJ", obj), ["a/arm.mtl", "a/more.mtl"]);
        let mtl = b"newmtl m\n  map_Kd -s 1 1 1 tex\\wood.png\nbump b.jpg\nKd 1 1 1\n";
        assert_eq!(references("arm.mtl", mtl), ["b.jpg", "tex/wood.png"]);
        let dae = b"<image><init_from>../tex/a.png</init_from></image><init_from>sampler</init_from><init_from>broken.png";
        assert_eq!(references("package://arm/meshes/x.dae", dae), ["package://arm/tex/a.png"]);
        assert_eq!(references("x.dae", dae), [""; 0]);
        assert_eq!(references("arm.stl", b"mtllib arm.mtl"), [""; 0]);
        let away = b"mtllib /etc/a.mtl C:\\a.mtl http://x/a.mtl ../../a.mtl";
        assert_eq!(references("a/arm.obj", away), [""; 0]);
    }
}
