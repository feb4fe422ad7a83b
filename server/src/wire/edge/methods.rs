//! Methods by their paths.

use std::collections::HashSet;
use std::sync::LazyLock;

use plantd_proto::FILE_DESCRIPTOR_SET;
use prost::Message as _;
use prost_types::FileDescriptorSet;

/// Paths of all methods of `plantd.v1`: the only ones that become labels of metrics.
static METHODS: LazyLock<HashSet<String>> = LazyLock::new(|| {
    // The descriptors were encoded by this crate's own build.
    let set = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).unwrap_or_default();
    let mut methods = HashSet::new();
    for file in &set.file {
        for service in &file.service {
            for method in &service.method {
                methods.insert(format!("/{}.{}/{}", file.package(), service.name(), method.name()));
            }
        }
    }
    methods
});

/// The path of a method of ours, as a label; `other` for anything else.
pub(super) fn method_label(path: &str) -> &'static str {
    METHODS.get(path).map_or("other", |path| path.as_str())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn methods_are_known_by_path() {
        let path = "/plantd.v1.PlantService/Drive";
        assert_eq!(method_label(path), path);
        assert_eq!(method_label("/plantd.v1.PlantService/Nonsense"), "other");
    }
}
