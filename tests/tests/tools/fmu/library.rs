//! An FMU as an importer sees it: its files, its description, its functions.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ffi::{CStr, CString, c_char, c_void};
use std::io::Read as _;
use std::path::Path;
use std::process::Command;

use libloading::{Library, Symbol};
use plantd_tests::server::binary;

pub(crate) type Handle = *mut c_void;
pub(crate) const OK: i32 = 0;
pub(crate) const DISCARD: i32 = 2;
pub(crate) const ERROR: i32 = 3;

thread_local! {
    static MESSAGES: RefCell<Vec<String>> = const { RefCell::new(Vec::new()) };
}

extern "C" fn log(_: Handle, status: i32, category: *const c_char, message: *const c_char) {
    // SAFETY: the library gives strings that end with a zero.
    let text = |pointer| unsafe { CStr::from_ptr(pointer) }.to_str().unwrap().to_owned();
    let expected = ["", "", "logStatusDiscard", "logStatusError", "logStatusFatal"];
    assert_eq!(text(category), expected[status as usize]);
    MESSAGES.with_borrow_mut(|messages| messages.push(text(message)));
}

/// What was told since the last time.
pub(crate) fn messages() -> String {
    MESSAGES.with_borrow_mut(std::mem::take).join("\n")
}

type Get = unsafe extern "C" fn(Handle, *const u32, usize, *mut f64, usize) -> i32;
type Set = unsafe extern "C" fn(Handle, *const u32, usize, *const f64, usize) -> i32;
type Instantiate = unsafe extern "C" fn(
    *const c_char,
    *const c_char,
    *const c_char,
    bool,
    bool,
    bool,
    bool,
    *const u32,
    usize,
    Handle,
    Option<extern "C" fn(Handle, i32, *const c_char, *const c_char)>,
    *const c_void,
) -> Handle;
type Step =
    unsafe extern "C" fn(Handle, f64, f64, bool, *mut bool, *mut bool, *mut bool, *mut f64) -> i32;
type Derivative = unsafe extern "C" fn(
    Handle,
    *const u32,
    usize,
    *const u32,
    usize,
    *const f64,
    usize,
    *mut f64,
    usize,
) -> i32;

/// An unpacked FMU with its library.
pub(crate) struct Fmu {
    directory: tempfile::TempDir,
    pub(crate) library: Library,
    pub(crate) token: String,
    pub(crate) references: BTreeMap<String, u32>,
}

impl Fmu {
    /// Lets `plantctl` make an FMU, and unpacks it.
    pub(crate) fn make(scene: &str, arguments: &[&str]) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("plant.fmu");
        let mut plantctl = Command::new(binary("plantctl").unwrap());
        plantctl.args(["fmu", scene, "-o"]).arg(&file).args(arguments);
        let output = plantctl.env_remove("PLANTD_ADDRESS").output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        unpack(&file, directory.path());
        let description = directory.path().join("modelDescription.xml");
        let description = std::fs::read_to_string(description).unwrap();
        let identifier = attribute(&description, "modelIdentifier");
        let binaries = format!("binaries/x86_64-linux/{identifier}.so");
        // SAFETY: the library is the one that is tested.
        let library = unsafe { Library::new(directory.path().join(binaries)) }.unwrap();
        let variables = description.split("<Float64 ").skip(1);
        let references = variables
            .map(|text| (attribute(text, "name"), attribute(text, "valueReference")))
            .map(|(name, reference)| (name, reference.parse().unwrap()))
            .collect();
        let token = attribute(&description, "instantiationToken");
        Self { directory, library, token, references }
    }

    /// A function of the library.
    pub(crate) fn function<T>(&self, name: &str) -> Symbol<'_, T> {
        // SAFETY: the types are those of the standard.
        unsafe { self.library.get(name.as_bytes()) }
            .unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    pub(crate) fn instantiate(&self) -> Instance<'_> {
        let instance = self.try_instantiate(&self.token, true, false, 0);
        assert!(!instance.is_null(), "{}", messages());
        Instance { fmu: self, handle: instance }
    }

    pub(crate) fn try_instantiate(
        &self,
        token: &str,
        with_resources: bool,
        event_mode: bool,
        intermediate: usize,
    ) -> Handle {
        let token = CString::new(token).unwrap();
        let resources = self.directory.path().join("resources/");
        let resources = CString::new(resources.to_str().unwrap()).unwrap();
        let path = if with_resources { resources.as_ptr() } else { std::ptr::null() };
        let instantiate = self.function::<Instantiate>("fmi3InstantiateCoSimulation");
        // SAFETY: all strings end with a zero.
        unsafe {
            instantiate(
                c"plant".as_ptr(),
                token.as_ptr(),
                path,
                false,
                false,
                event_mode,
                true,
                std::ptr::null(),
                intermediate,
                std::ptr::null_mut(),
                Some(log),
                std::ptr::null(),
            )
        }
    }

    /// Value references of variables.
    pub(crate) fn find(&self, names: &[&str]) -> Vec<u32> {
        let find = |name: &&str| {
            *self.references.get(*name).unwrap_or_else(|| panic!("there is no variable {name}"))
        };
        names.iter().map(find).collect()
    }
}

/// An instance; freed when it is dropped.
pub(crate) struct Instance<'a> {
    pub(crate) fmu: &'a Fmu,
    pub(crate) handle: Handle,
}

impl Instance<'_> {
    pub(crate) fn call(&self, function: &str) -> i32 {
        let function = self.fmu.function::<unsafe extern "C" fn(Handle) -> i32>(function);
        // SAFETY: it takes a handle alone.
        unsafe { function(self.handle) }
    }

    pub(crate) fn enter_initialization(&self, start_s: f64, stop_s: Option<f64>) -> i32 {
        type Enter = unsafe extern "C" fn(Handle, bool, f64, f64, bool, f64) -> i32;
        let enter = self.fmu.function::<Enter>("fmi3EnterInitializationMode");
        let stop = stop_s.unwrap_or(0.0);
        // SAFETY: it takes numbers.
        unsafe { enter(self.handle, false, 0.0, start_s, stop_s.is_some(), stop) }
    }

    /// From the instantiation to the step mode.
    #[track_caller]
    pub(crate) fn initialize(&self) {
        assert_eq!(self.enter_initialization(0.0, None), OK, "{}", messages());
        assert_eq!(self.call("fmi3ExitInitializationMode"), OK, "{}", messages());
    }

    pub(crate) fn try_get(&self, references: &[u32], values: &mut [f64]) -> i32 {
        let get = self.fmu.function::<Get>("fmi3GetFloat64");
        // SAFETY: the counts are those of the slices.
        unsafe {
            get(
                self.handle,
                references.as_ptr(),
                references.len(),
                values.as_mut_ptr(),
                values.len(),
            )
        }
    }

    #[track_caller]
    pub(crate) fn get(&self, names: &[&str]) -> Vec<f64> {
        let mut values = vec![0.0; names.len()];
        let status = self.try_get(&self.fmu.find(names), &mut values);
        assert_eq!(status, OK, "{}", messages());
        values
    }

    pub(crate) fn try_set(&self, references: &[u32], values: &[f64]) -> i32 {
        let set = self.fmu.function::<Set>("fmi3SetFloat64");
        // SAFETY: the counts are those of the slices.
        unsafe {
            set(self.handle, references.as_ptr(), references.len(), values.as_ptr(), values.len())
        }
    }

    #[track_caller]
    pub(crate) fn set(&self, names: &[&str], values: &[f64]) {
        assert_eq!(self.try_set(&self.fmu.find(names), values), OK, "{}", messages());
    }

    /// Takes a communication step; the last successful time.
    pub(crate) fn try_step(&self, at_s: f64, size_s: f64) -> (i32, f64) {
        let step = self.fmu.function::<Step>("fmi3DoStep");
        let (mut events, mut ends, mut early, mut last) = (true, true, true, f64::NAN);
        // SAFETY: the pointers are those of variables.
        let status = unsafe {
            step(self.handle, at_s, size_s, true, &mut events, &mut ends, &mut early, &mut last)
        };
        assert!(!events && !ends && !early);
        (status, last)
    }

    #[track_caller]
    pub(crate) fn step(&self, at_s: f64, size_s: f64) {
        assert_eq!(self.try_step(at_s, size_s), (OK, at_s + size_s), "{}", messages());
    }

    pub(crate) fn derivative(
        &self,
        function: &str,
        [unknowns, knowns]: [&[&str]; 2],
        seed: &[f64],
        count: usize,
    ) -> Result<Vec<f64>, String> {
        let (unknowns, knowns) = (self.fmu.find(unknowns), self.fmu.find(knowns));
        let function = self.fmu.function::<Derivative>(function);
        let mut sensitivity = vec![f64::NAN; count];
        // SAFETY: the counts are those of the slices.
        let status = unsafe {
            function(
                self.handle,
                unknowns.as_ptr(),
                unknowns.len(),
                knowns.as_ptr(),
                knowns.len(),
                seed.as_ptr(),
                seed.len(),
                sensitivity.as_mut_ptr(),
                count,
            )
        };
        if status == OK { Ok(sensitivity) } else { Err(messages()) }
    }

    pub(crate) fn save(&self) -> Handle {
        let mut state = std::ptr::null_mut();
        let save = self
            .fmu
            .function::<unsafe extern "C" fn(Handle, *mut Handle) -> i32>("fmi3GetFMUState");
        // SAFETY: the pointer is that of a variable.
        assert_eq!(unsafe { save(self.handle, &mut state) }, OK, "{}", messages());
        state
    }

    pub(crate) fn restore(&self, state: Handle) -> i32 {
        let restore =
            self.fmu.function::<unsafe extern "C" fn(Handle, Handle) -> i32>("fmi3SetFMUState");
        // SAFETY: it takes two handles.
        unsafe { restore(self.handle, state) }
    }

    pub(crate) fn free_state(&self, state: &mut Handle) -> i32 {
        let free = self
            .fmu
            .function::<unsafe extern "C" fn(Handle, *mut Handle) -> i32>("fmi3FreeFMUState");
        // SAFETY: the pointer is that of a variable.
        unsafe { free(self.handle, state) }
    }

    #[track_caller]
    pub(crate) fn serialize(&self, state: Handle) -> Vec<u8> {
        let mut size = 0;
        let measure = self.fmu.function::<unsafe extern "C" fn(Handle, Handle, *mut usize) -> i32>(
            "fmi3SerializedFMUStateSize",
        );
        // SAFETY: the pointer is that of a variable.
        assert_eq!(unsafe { measure(self.handle, state, &mut size) }, OK, "{}", messages());
        let mut bytes = vec![0; size];
        let serialize =
            self.fmu.function::<unsafe extern "C" fn(Handle, Handle, *mut u8, usize) -> i32>(
                "fmi3SerializeFMUState",
            );
        // SAFETY: the size is that of the vector.
        let status = unsafe { serialize(self.handle, state, bytes.as_mut_ptr(), size) };
        assert_eq!(status, OK, "{}", messages());
        // SAFETY: there is room for one less.
        assert_eq!(unsafe { serialize(self.handle, state, bytes.as_mut_ptr(), size - 1) }, ERROR);
        messages();
        bytes
    }

    pub(crate) fn deserialize(&self, bytes: &[u8]) -> (i32, Handle) {
        let mut state = std::ptr::null_mut();
        type Read = unsafe extern "C" fn(Handle, *const u8, usize, *mut Handle) -> i32;
        let read = self.fmu.function::<Read>("fmi3DeserializeFMUState");
        // SAFETY: the size is that of the slice, the pointer that of a variable.
        let status = unsafe { read(self.handle, bytes.as_ptr(), bytes.len(), &mut state) };
        (status, state)
    }
}

impl Drop for Instance<'_> {
    fn drop(&mut self) {
        let free = self.fmu.function::<unsafe extern "C" fn(Handle)>("fmi3FreeInstance");
        // SAFETY: it takes any handle.
        unsafe { free(self.handle) };
    }
}

fn unpack(file: &Path, folder: &Path) {
    let mut archive = zip::ZipArchive::new(std::fs::File::open(file).unwrap()).unwrap();
    for index in 0..archive.len() {
        let mut entry = archive.by_index(index).unwrap();
        let path = folder.join(entry.name().unwrap().as_ref());
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
}

fn attribute(text: &str, name: &str) -> String {
    let rest = text.split_once(&format!("{name}=\"")).unwrap_or_else(|| panic!("no {name}")).1;
    rest.split('"').next().unwrap().to_owned()
}
