#!/bin/sh
# Installs the C and C++ library: install.sh PREFIX [FOLDER]
#
# Builds it, unless a folder with libplantd.so and libplantd.a is given, and puts libraries, headers and the
# files for pkg-config and CMake below PREFIX (/usr/local, $HOME/.local).
set -eu

if [ $# -lt 1 ] || [ $# -gt 2 ]; then
    echo "install.sh PREFIX [FOLDER]" >&2
    exit 2
fi
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$1"
prefix=$(cd "$1" && pwd)
if [ $# -eq 2 ]; then
    built=$2
else
    cd "$here/../.."
    cargo build --release --locked -p plantd-link-c
    built=${CARGO_TARGET_DIR:-target}/release
fi
version=$(sed -n 's/^version = "\(.*\)"/\1/p' "$here/../../Cargo.toml" | head -n 1)
libraries=$prefix/lib
# What the standard library of Rust links with.
system="-lgcc_s -lutil -lrt -lpthread -lm -ldl -lc"

mkdir -p "$prefix/include" "$libraries/pkgconfig" "$libraries/cmake/plantd"
cp "$here/plantd.h" "$here/plantd.hpp" "$here/plantd_link.h" "$prefix/include/"
cp "$built/libplantd.a" "$libraries/"
cp "$built/libplantd.so" "$libraries/libplantd.so.$version"
ln -sf "libplantd.so.$version" "$libraries/libplantd.so.0"
ln -sf libplantd.so.0 "$libraries/libplantd.so"

cat >"$libraries/pkgconfig/plantd.pc" <<END
prefix=$prefix
libdir=\${prefix}/lib
includedir=\${prefix}/include

Name: plantd
Description: Shared-memory driver of plants that plantd simulates
Version: $version
Libs: -L\${libdir} -lplantd
Libs.private: $system
Cflags: -I\${includedir}
END

cat >"$libraries/cmake/plantd/plantdConfig.cmake" <<END
# Targets plantd::plantd (shared) and plantd::static.
get_filename_component(PLANTD_PREFIX "\${CMAKE_CURRENT_LIST_DIR}/../../.." ABSOLUTE)
if(NOT TARGET plantd::plantd)
  add_library(plantd::plantd SHARED IMPORTED)
  set_target_properties(plantd::plantd PROPERTIES
    IMPORTED_LOCATION "\${PLANTD_PREFIX}/lib/libplantd.so.$version"
    IMPORTED_SONAME libplantd.so.0
    INTERFACE_INCLUDE_DIRECTORIES "\${PLANTD_PREFIX}/include")
  add_library(plantd::static STATIC IMPORTED)
  set_target_properties(plantd::static PROPERTIES
    IMPORTED_LOCATION "\${PLANTD_PREFIX}/lib/libplantd.a"
    INTERFACE_LINK_LIBRARIES "$system"
    INTERFACE_INCLUDE_DIRECTORIES "\${PLANTD_PREFIX}/include")
endif()
END

cat >"$libraries/cmake/plantd/plantdConfigVersion.cmake" <<END
set(PACKAGE_VERSION "$version")
if(PACKAGE_VERSION VERSION_LESS PACKAGE_FIND_VERSION)
  set(PACKAGE_VERSION_COMPATIBLE FALSE)
else()
  set(PACKAGE_VERSION_COMPATIBLE TRUE)
  if(PACKAGE_FIND_VERSION STREQUAL PACKAGE_VERSION)
    set(PACKAGE_VERSION_EXACT TRUE)
  endif()
endif()
END
echo "plantd $version is in $prefix"
