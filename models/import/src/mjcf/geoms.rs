//! Shapes and sites of bodies.

use nalgebra::{Isometry3, Matrix3, Translation3, Unit, Vector3};
use plantd_models::scene::{self, MAX_VISUALS, Visual};
use roxmltree::Node;

use crate::document::Reader;
use crate::inertia::Inertia;
use crate::mjcf::classes::Settings;
use crate::mjcf::settings::{TINY, from_z};
use crate::mjcf::shapes::Shape;
use crate::mjcf::tree::{Geom, Place, Site, Walk, named, rotation};

impl<'a> Walk<'_, 'a, '_> {
    /// Reads a site.
    pub(super) fn site(&mut self, node: Node<'a, 'a>, place: &Place) {
        let settings = self.classes.settings(self.reader, node, place.class, "site");
        let mut pose = self.compiler(node).pose(self.reader, &settings);
        if let Some(ends) = settings.numbers::<6>(self.reader, "fromto") {
            pose = self.between(node, ends).0;
        }
        let name = named(node.attribute("name").unwrap_or_default(), place);
        self.register(2, node, &name, self.tree.sites.len());
        self.tree.sites.push(Site { body: place.body, pose: place.frame * pose });
        self.count(node);
    }

    /// Midway between two points, z from the second to the first, and half their distance.
    fn between(&mut self, node: Node<'a, 'a>, ends: [f64; 6]) -> (Isometry3<f64>, f64) {
        let [a, b, c, d, e, f] = ends;
        let (from, to) = (Vector3::new(a, b, c), Vector3::new(d, e, f));
        let along = from - to;
        let direction = Unit::try_new(along, TINY).unwrap_or_else(|| {
            self.reader.fail(node, "the two points of `fromto` are one");
            Vector3::z_axis()
        });
        let middle = Translation3::from((from + to) / 2.0);
        (Isometry3::from_parts(middle, from_z(direction)), along.norm() / 2.0)
    }

    /// Reads a shape: what it weighs and how it looks.
    pub(super) fn geom(&mut self, node: Node<'a, 'a>, place: &Place) {
        self.count(node);
        let settings = self.classes.settings(self.reader, node, place.class, "geom");
        let bit = |reader: &mut Reader<'_>, name| settings.number(reader, name).unwrap_or(1.0);
        if ["contype", "conaffinity"].iter().any(|name| bit(self.reader, name) != 0.0) {
            self.tree.touching.get_or_insert((node, 0)).1 += 1;
        }
        let mut pose = self.compiler(node).pose(self.reader, &settings);
        let mut size: [f64; 3] = settings.first_numbers(self.reader, "size");
        const KINDS: [&str; 9] =
            ["sphere", "capsule", "cylinder", "ellipsoid", "box", "mesh", "plane", "hfield", "sdf"];
        let kind = settings.keyword(self.reader, "type", &KINDS).unwrap_or(0);
        if let Some(ends) = settings.numbers::<6>(self.reader, "fromto")
            && (1..5).contains(&kind)
        {
            let (middle, half) = self.between(node, ends);
            pose = middle;
            size = if kind < 3 { [size[0], half, size[2]] } else { [size[0], size[0], half] };
        }
        let pose = place.frame * pose;
        let [radius, half, _] = size;
        let shape = match (kind, settings.text("mesh")) {
            (0, None) => Some(Shape::Sphere { radius }),
            (1, None) => Some(Shape::Capsule { radius, half }),
            (2, None) => Some(Shape::Cylinder { radius, half }),
            (3, None) => Some(Shape::Ellipsoid { radii: size.into() }),
            (4, None) => Some(Shape::Box { halves: size.into() }),
            _ => None,
        };
        let lengths = match kind {
            0 => 1,
            1 | 2 => 2,
            _ => 3,
        };
        if shape.is_some() && size[..lengths].iter().any(|length| *length <= 0.0) {
            let (name, words) = (KINDS[kind], ["one number", "two numbers", "three numbers"]);
            let message =
                format!("`size` of a {name} must be {} greater than 0", words[lengths - 1]);
            self.reader.fail(node, message);
        }
        let Some(body) = place.body else { return };
        self.weigh(body, &settings, shape, &pose);
        self.show(body, &settings, shape, &pose);
    }

    /// Adds the inertia of a geom to those of its body, if it counts.
    fn weigh(
        &mut self,
        body: usize,
        settings: &Settings<'a>,
        shape: Option<Shape>,
        pose: &Isometry3<f64>,
    ) {
        let group = settings.number(self.reader, "group").unwrap_or_default();
        let [least, most] = self.compiler(settings.node()).inertia_groups;
        let mass = settings.number(self.reader, "mass");
        let density = settings.number(self.reader, "density").unwrap_or(1000.0);
        let is_shell = settings.is_true(self.reader, "shellinertia");
        if mass.unwrap_or(density) < 0.0 {
            self.reader.fail(settings.node(), "`mass` and `density` must not be negative");
        }
        let counts = self.tree.bodies[body].is_weighed;
        if !counts || !(least..=most).contains(&group) || mass.unwrap_or(density) == 0.0 {
            return;
        }
        let Some(shape) = shape else {
            if !matches!(settings.text("type"), Some("plane" | "hfield")) {
                let (node, pose) = (settings.node(), *pose);
                let is_mesh = settings.text("type") == Some("mesh") && !is_shell;
                let mesh = settings.text("mesh").filter(|_| is_mesh);
                self.tree.bodies[body].meshed.push(Geom { node, mesh, pose, mass, density });
            }
            return;
        };
        let volume = shape.volume(is_shell);
        let mass = mass.unwrap_or(density * volume);
        if volume > TINY && mass > TINY {
            let tensor = Matrix3::from_diagonal(&shape.moments(mass, is_shell));
            let own = Inertia { mass, center: Vector3::zeros(), tensor };
            self.tree.bodies[body].geoms.push(own.at(pose));
        }
    }

    /// Adds a geom to what shows its body.
    fn show(
        &mut self,
        body: usize,
        settings: &Settings<'a>,
        shape: Option<Shape>,
        pose: &Isometry3<f64>,
    ) {
        let mesh = settings.text("mesh").and_then(|name| self.meshes.shape(name));
        let own = shape.map(|shape| (drawn(shape), Isometry3::identity()));
        let Some((shape, place)) = own.or(mesh) else { return };
        if self.items >= MAX_VISUALS {
            return;
        }
        let color = settings.numbers::<4>(self.reader, "rgba");
        let pose = pose * place;
        self.tree.bodies[body].visuals.push(Visual {
            shape,
            translation: pose.translation.vector.into(),
            rotation: rotation(&pose.rotation),
            color: color.map(|color| color.map(|part| part.clamp(0.0, 1.0))),
        });
    }
}

fn drawn(shape: Shape) -> scene::Shape {
    match shape {
        Shape::Sphere { radius } => scene::Shape::Sphere { radius },
        Shape::Capsule { radius, half } => scene::Shape::Capsule { radius, length: 2.0 * half },
        Shape::Cylinder { radius, half } => scene::Shape::Cylinder { radius, length: 2.0 * half },
        Shape::Ellipsoid { radii } => scene::Shape::Ellipsoid { radii: radii.into() },
        Shape::Box { halves } => scene::Shape::Box { size: (halves * 2.0).into() },
    }
}
