//! Where ONNX Runtime's shared library is, if no variable names it.

use std::env;
use std::env::consts::{DLL_EXTENSION, DLL_PREFIX, DLL_SUFFIX};
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

/// The library that `ORT_DYLIB_PATH` names; or that of a Python environment which has the program; or one that
/// `deploy/native.py` has downloaded; or that of the system.
pub(super) fn library() -> PathBuf {
    let variable = |name: &str| env::var_os(name).filter(|value| !value.is_empty());
    if let Some(given) = variable("ORT_DYLIB_PATH") {
        return given.into();
    }
    let program = env::current_exe().ok().and_then(|program| program.canonicalize().ok());
    let installed = program.as_deref().and_then(in_environment);
    let downloaded = || cache(variable).as_deref().and_then(in_cache);
    installed.or_else(downloaded).unwrap_or_else(|| format!("{DLL_PREFIX}onnxruntime{DLL_SUFFIX}").into())
}

/// The folder of the downloads, as in `deploy/native.py`.
fn cache(variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let home = || variable("HOME").map(|home| Path::new(&home).join(".cache"));
    let of_user = || variable("XDG_CACHE_HOME").map(PathBuf::from).or_else(home);
    variable("GRASPD_CACHE").map(PathBuf::from).or_else(|| Some(of_user()?.join("graspd")))
}

/// The library of the Python package `onnxruntime` in the environment in which `program` is installed.
fn in_environment(program: &Path) -> Option<PathBuf> {
    let lib = program.parent()?.parent()?.join("lib");
    let pythons = entries(&lib, "python");
    let packages = pythons.iter().flat_map(|python| ["site-packages", "dist-packages"].map(|name| python.join(name)));
    packages.into_iter().find_map(|packages| in_folder(&packages.join("onnxruntime/capi")))
}

/// The library that was downloaded: the one with OpenVINO, if there is one. That for GPUs has to be asked for.
fn in_cache(cache: &Path) -> Option<PathBuf> {
    let platform = format!("{}-{}", if cfg!(target_os = "macos") { "Darwin" } else { "Linux" }, machine());
    let folders = ["onnxruntime-openvino-", "onnxruntime-"].into_iter().flat_map(|name| entries(cache, name));
    let of_platform = folders.filter(|folder| {
        let name = folder.file_name().unwrap_or_default().to_string_lossy();
        name.ends_with(&platform) && !name.starts_with("onnxruntime-gpu-")
    });
    of_platform.into_iter().find_map(|folder| in_folder(&folder))
}

/// The machine as in the names of the downloads.
fn machine() -> &'static str {
    match (env::consts::OS, env::consts::ARCH) {
        ("macos", "aarch64") => "arm64",
        (_, machine) => machine,
    }
}

/// The library in a folder: `libonnxruntime.so.1.24.1`, or `libonnxruntime.1.31.1.dylib`.
fn in_folder(folder: &Path) -> Option<PathBuf> {
    entries(folder, &format!("{DLL_PREFIX}onnxruntime."))
        .into_iter()
        .find(|path| path.to_string_lossy().contains(&format!(".{DLL_EXTENSION}")))
}

/// Entries of a folder whose names start with `prefix`, the last name first: the newest version.
fn entries(folder: &Path, prefix: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let named = entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(prefix));
    let mut paths: Vec<PathBuf> = named.map(|entry| entry.path()).collect();
    paths.sort_unstable_by(|a, b| b.cmp(a));
    paths
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(path: PathBuf) -> PathBuf {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, "").unwrap();
        path
    }

    #[test]
    fn the_library_is_that_of_the_programs_environment() {
        let prefix = tempfile::tempdir().unwrap();
        let program = prefix.path().join("bin/graspd");
        assert_eq!(in_environment(&program), None);
        let capi = prefix.path().join("lib/python3.12/site-packages/onnxruntime/capi");
        file(capi.join(format!("{DLL_PREFIX}onnxruntime_providers_shared{DLL_SUFFIX}")));
        let name = if cfg!(target_os = "macos") { "libonnxruntime.1.24.1.dylib" } else { "libonnxruntime.so.1.24.1" };
        let library = file(capi.join(name));
        assert_eq!(in_environment(&program), Some(library));
    }

    #[test]
    fn the_downloaded_library_is_that_with_openvino_and_not_that_for_gpus() {
        let cache = tempfile::tempdir().unwrap();
        let platform = format!("{}-{}", if cfg!(target_os = "macos") { "Darwin" } else { "Linux" }, machine());
        let download = |build: &str, platform: &str| {
            let name = format!("{DLL_PREFIX}onnxruntime{DLL_SUFFIX}");
            file(cache.path().join(format!("onnxruntime-{build}-{platform}")).join(name))
        };
        download("gpu-1.31.1", &platform);
        download("1.31.1", "Plan9-vax");
        assert_eq!(in_cache(cache.path()), None);
        let plain = download("1.31.1", &platform);
        assert_eq!(in_cache(cache.path()), Some(plain));
        let openvino = download("openvino-1.24.1", &platform);
        assert_eq!(in_cache(cache.path()), Some(openvino));
    }

    #[test]
    fn the_cache_is_that_of_the_user_unless_a_variable_names_it() {
        let set = |variables: &'static [(&str, &str)]| {
            cache(move |name| variables.iter().find(|(key, _)| *key == name).map(|(_, value)| value.into()))
        };
        assert_eq!(set(&[("HOME", "/home/a")]), Some("/home/a/.cache/graspd".into()));
        assert_eq!(set(&[("HOME", "/home/a"), ("XDG_CACHE_HOME", "/c")]), Some("/c/graspd".into()));
        assert_eq!(set(&[("GRASPD_CACHE", "/g"), ("HOME", "/home/a")]), Some("/g".into()));
        assert_eq!(set(&[]), None);
    }
}
