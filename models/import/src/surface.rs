//! Surfaces of triangles, as STL, OBJ and MSH files have them.

use std::fmt::Display;

/// Triangles of one surface at most.
const TRIANGLES_MAX: usize = 1 << 22;

/// Points, and triangles of three of them each, counter-clockwise when seen from outside.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Surface {
    /// In single precision, as these files and MuJoCo have them.
    pub(crate) points: Vec<[f32; 3]>,
    pub(crate) triangles: Vec<[u32; 3]>,
}

impl Surface {
    /// Reads a file; the end of its name says what it is.
    pub(crate) fn read(name: &str, bytes: &[u8]) -> Result<Self, String> {
        let end = name.rsplit_once('.').map_or("", |(_, end)| end).to_ascii_lowercase();
        let read = match end.as_str() {
            "stl" => stl(bytes),
            "obj" => obj(bytes),
            "msh" => msh(bytes),
            _ => Err("its name must end in `.stl`, `.obj` or `.msh`".to_owned()),
        };
        read?.checked()
    }

    /// Of coordinates and indices one after the other.
    pub(crate) fn of_lists(points: &[f64], triangles: &[f64]) -> Result<Self, String> {
        if !points.len().is_multiple_of(3) || !triangles.len().is_multiple_of(3) {
            return Err("`vertex` and `face` must have three numbers for each".to_owned());
        }
        let index = |x: &f64| {
            let is_whole = x.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(x);
            is_whole.then_some(*x as u32).ok_or_else(|| format!("`face` has {x}"))
        };
        let indices: Vec<u32> = triangles.iter().map(index).collect::<Result<_, _>>()?;
        let points: Vec<f32> = points.iter().map(|x| *x as f32).collect();
        Self { points: triples(&points), triangles: triples(&indices) }.checked()
    }

    fn checked(self) -> Result<Self, String> {
        let (points, triangles) = (self.points.len(), self.triangles.len());
        if triangles == 0 {
            return Err("there is no triangle".to_owned());
        }
        if triangles > TRIANGLES_MAX {
            return Err(format!("{triangles} triangles; at most {TRIANGLES_MAX} are read"));
        }
        let is_beyond = |index: &&u32| **index as usize >= points;
        if let Some(index) = self.triangles.iter().flatten().find(is_beyond) {
            return Err(format!("a triangle has point {index}; there are {points}"));
        }
        if self.points.iter().flatten().any(|x| !x.is_finite()) {
            return Err("a coordinate is not finite".to_owned());
        }
        Ok(self)
    }

    /// Appends a triangle with points of its own.
    fn push(&mut self, corners: [[f32; 3]; 3]) {
        let first = self.points.len() as u32;
        self.points.extend(corners);
        self.triangles.push([first, first + 1, first + 2]);
    }
}

fn triples<T: Copy>(all: &[T]) -> Vec<[T; 3]> {
    all.chunks_exact(3).map(|chunk| [chunk[0], chunk[1], chunk[2]]).collect()
}

/// The words of four bytes from an offset on, each as a number.
fn words<T>(bytes: &[u8], take: impl Fn([u8; 4]) -> T) -> Vec<T> {
    bytes.chunks_exact(4).map(|word| take([word[0], word[1], word[2], word[3]])).collect()
}

/// Binary: 80 bytes of anything, the number of triangles, and 50 bytes each, normal, corners, 2 of anything.
/// Everything else is text.
fn stl(bytes: &[u8]) -> Result<Surface, String> {
    const HEAD: usize = 84;
    const TRIANGLE: usize = 50;
    let count = bytes.get(80..HEAD).map(|head| words(head, u32::from_le_bytes)[0] as usize);
    let body = bytes.get(HEAD..).unwrap_or_default();
    if count.is_none_or(|count| Some(body.len()) != count.checked_mul(TRIANGLE)) {
        return match std::str::from_utf8(bytes) {
            Ok(text) if text.trim_start().starts_with("solid") => stl_text(text),
            _ => {
                let says = count.map_or("no number".to_owned(), |count| count.to_string());
                let there = body.len() / TRIANGLE;
                Err(format!("no STL: it says {says} of triangles, and has {there}"))
            }
        };
    }
    let mut surface = Surface::default();
    for triangle in body.chunks_exact(TRIANGLE).take(TRIANGLES_MAX + 1) {
        let corners = triples(&words(&triangle[12..48], f32::from_le_bytes));
        surface.push([corners[0], corners[1], corners[2]]);
    }
    Ok(surface)
}

fn stl_text(text: &str) -> Result<Surface, String> {
    let (mut surface, mut corners) = (Surface::default(), Vec::new());
    for (number, line) in (1..).zip(text.lines()) {
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            Some("vertex") => corners.push(point(number, words)?),
            Some("endloop") => {
                let [a, b, c] = corners[..] else {
                    return Err(format!("line {number}: {} corners; must be 3", corners.len()));
                };
                surface.push([a, b, c]);
                corners.clear();
            }
            _ => {}
        }
    }
    if corners.is_empty() { Ok(surface) } else { Err("it ends within a triangle".to_owned()) }
}

/// The three numbers that follow.
fn point<'t>(
    line: impl Display,
    mut words: impl Iterator<Item = &'t str>,
) -> Result<[f32; 3], String> {
    let mut next = || words.next().and_then(|word| word.parse::<f32>().ok());
    let all = (next(), next(), next());
    let (Some(x), Some(y), Some(z)) = all else {
        return Err(format!("line {line}: three numbers are needed"));
    };
    Ok([x, y, z])
}

/// `v x y z` and `f a b c ...`, in which indices begin with 1, or are counted from the end if negative, and may have
/// others after a `/`. A face of more corners is a fan.
fn obj(bytes: &[u8]) -> Result<Surface, String> {
    let text = String::from_utf8_lossy(bytes);
    let mut surface = Surface::default();
    for (number, line) in (1..).zip(text.lines()) {
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            Some("v") => surface.points.push(point(number, words)?),
            Some("f") => {
                let corner = |word: &str| {
                    let index = word.split('/').next().and_then(|word| word.parse::<i64>().ok());
                    let count = surface.points.len() as i64;
                    let from_zero = match index {
                        Some(index) if index > 0 => Some(index - 1),
                        Some(index) if index < 0 => Some(count + index),
                        _ => None,
                    };
                    from_zero
                        .and_then(|index| u32::try_from(index).ok())
                        .ok_or_else(|| format!("line {number}: `{word}` is no corner"))
                };
                let corners: Vec<u32> = words.map(corner).collect::<Result<_, _>>()?;
                if corners.len() < 3 {
                    return Err(format!("line {number}: a face has three corners or more"));
                }
                let fan = corners.windows(2).skip(1).map(|pair| [corners[0], pair[0], pair[1]]);
                surface.triangles.extend(fan);
                if surface.triangles.len() > TRIANGLES_MAX {
                    break;
                }
            }
            _ => {}
        }
    }
    Ok(surface)
}

/// MuJoCo's own: the numbers of points, normals, texture coordinates and triangles, then each of them.
fn msh(bytes: &[u8]) -> Result<Surface, String> {
    let no = || "no MSH: its length is not that of what its head counts".to_owned();
    let head = bytes.get(..16).ok_or_else(no)?;
    let counts: Vec<u64> = words(head, i32::from_le_bytes)
        .into_iter()
        .map(|n| u64::try_from(n).map_err(|_| no()))
        .collect::<Result<_, _>>()?;
    let [points, normals, textures, triangles] = counts[..] else { return Err(no()) };
    let total = 16 + 4 * (3 * points + 3 * normals + 2 * textures + 3 * triangles);
    if total != bytes.len() as u64 {
        return Err(no());
    }
    // Both are below the length of the file.
    let first = 16 + 12 * points as usize;
    let last = bytes.len() - 12 * triangles as usize;
    Ok(Surface {
        points: triples(&words(&bytes[16..first], f32::from_le_bytes)),
        triangles: triples(&words(&bytes[last..], u32::from_le_bytes)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tetrahedron, whose corners come in the order of each file.
    const POINTS: [[f32; 3]; 4] = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    const TRIANGLES: [[u32; 3]; 4] = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];

    fn corners(surface: &Surface) -> Vec<[[f32; 3]; 3]> {
        let point = |i: u32| surface.points[i as usize];
        surface.triangles.iter().map(|t| t.map(point)).collect()
    }

    fn tetrahedron() -> Surface {
        Surface { points: POINTS.to_vec(), triangles: TRIANGLES.to_vec() }
    }

    fn binary() -> Vec<u8> {
        let mut bytes = b"solid is what many a binary file begins with".to_vec();
        bytes.resize(80, b' ');
        bytes.extend(4_u32.to_le_bytes());
        for triangle in corners(&tetrahedron()) {
            bytes.extend([0; 12]);
            bytes.extend(triangle.iter().flatten().flat_map(|x| x.to_le_bytes()));
            bytes.extend([0; 2]);
        }
        bytes
    }

    #[test]
    fn all_files_have_the_same_triangles() {
        let expected = corners(&tetrahedron());
        let facet = |t: &[[f32; 3]; 3]| {
            let lines = t.map(|[x, y, z]| format!("vertex {x} {y} {z:e}\n"));
            format!("facet normal 0 0 0\nouter loop\n{}endloop\nendfacet\n", lines.concat())
        };
        let text: String = expected.iter().map(facet).collect();
        let text = format!("solid t\n{text}endsolid t\n");
        let obj = "# t\nv 0 0 0\nv 1 0 0\r\nv 0 1 0\nvn 0 0 1\nv 0 0 1\n\
                   f 1/1/1 3 2\nf 1//1 2 4\nf -4 -1 -2\nf 2 3 4\n";
        let mut msh: Vec<u8> = [4_u32, 0, 0, 4].iter().flat_map(|n| n.to_le_bytes()).collect();
        msh.extend(POINTS.iter().flatten().flat_map(|x| x.to_le_bytes()));
        msh.extend(TRIANGLES.iter().flatten().flat_map(|i| i.to_le_bytes()));
        for (name, bytes) in [
            ("a.STL", binary()),
            ("a.stl", text.into_bytes()),
            ("b/a.obj", obj.into()),
            ("a.msh", msh),
        ] {
            let read =
                Surface::read(name, &bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
            assert_eq!(corners(&read), expected, "{name}");
        }
        let quad =
            Surface::read("q.obj", b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n").unwrap();
        assert_eq!(quad.triangles, [[0, 1, 2], [0, 2, 3]]);
    }

    #[test]
    fn broken_files_say_what_is_wrong() {
        let cut = &binary()[..200];
        let huge = [&[b'x'; 80][..], &u32::MAX.to_le_bytes(), &[0; 50]].concat();
        let head: Vec<u8> = [i32::MAX; 4].iter().flat_map(|n| n.to_le_bytes()).collect();
        for (name, bytes, part) in [
            ("a.dae", &b"x"[..], "must end in"),
            ("a", b"x", "must end in"),
            ("a.stl", b"", "no STL"),
            ("a.stl", cut, "no STL: it says 4"),
            ("a.stl", &huge, "no STL"),
            ("a.stl", b"solid\n", "no triangle"),
            ("a.stl", b"solid\nvertex 1 2\n", "line 2: three numbers"),
            ("a.stl", b"solid\nvertex 1 2 3\nendloop\n", "1 corners"),
            ("a.stl", b"solid\nvertex 1 2 3\n", "within"),
            ("a.obj", b"f 1 2 3\n", "there are 0"),
            ("a.obj", b"v 0 0 0\nf 1 2\n", "line 2"),
            ("a.obj", b"v 0 0 0\nf 1 0 1\n", "`0` is no corner"),
            ("a.obj", b"v 0 0 0\nf 1 -2 1\n", "`-2` is no corner"),
            ("a.obj", b"v 0 0 nan\nf 1 1 1\n", "not finite"),
            ("a.obj", b"v 0 0 1e39\nf 1 1 1\n", "not finite"),
            ("a.msh", b"123", "no MSH"),
            ("a.msh", &head, "no MSH"),
        ] {
            let error = Surface::read(name, bytes).unwrap_err();
            assert!(error.contains(part), "{name}: {error}");
        }
        assert!(Surface::of_lists(&[0.0; 4], &[]).is_err());
        assert!(Surface::of_lists(&[0.0; 9], &[0.0, 1.0, 1.5]).unwrap_err().contains("1.5"));
        assert!(Surface::of_lists(&[0.0; 9], &[0.0, 1.0, 3.0]).unwrap_err().contains("point 3"));
    }
}
