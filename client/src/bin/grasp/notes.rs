//! Notes on stderr about the files that are read: what was assumed, corrected or left out.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

thread_local! {
    static FILE: RefCell<Option<PathBuf>> = const { RefCell::new(None) };
}

/// Calls `read`; notes that it makes name the file.
pub(crate) fn about<T>(path: &Path, read: impl FnOnce(&Path) -> T) -> T {
    let outer = FILE.replace(Some(path.to_owned()));
    let value = read(path);
    FILE.set(outer);
    value
}

/// Prints a note once: `grasp watch` reads its files again and again.
pub(crate) fn note(text: impl Display) {
    static PRINTED: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    let file = FILE.with_borrow(|file| file.as_ref().map(|file| format!("{}: ", file.display())));
    let text = format!("grasp: {}{text}", file.unwrap_or_default());
    if PRINTED.lock().unwrap_or_else(PoisonError::into_inner).insert(text.clone()) {
        eprintln!("{text}");
    }
}
