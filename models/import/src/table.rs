//! What is done with each element and attribute of a format.

/// How something of a file is treated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Treatment {
    /// It is read; the reader notes where a value cannot be taken exactly.
    Read,
    /// It does not change the motion; why.
    NoEffect(&'static str),
    /// It changes the motion, or may; what to do.
    Refused(&'static str),
}

/// An element of a format.
#[derive(Debug)]
pub(crate) struct Element {
    pub(crate) name: &'static str,
    pub(crate) treatment: Treatment,
    pub(crate) attributes: &'static [(&'static str, Treatment)],
    pub(crate) children: &'static [Element],
}

impl Element {
    /// One that is read.
    pub(crate) const fn read(
        name: &'static str,
        attributes: &'static [(&'static str, Treatment)],
        children: &'static [Element],
    ) -> Self {
        Self { name, treatment: Treatment::Read, attributes, children }
    }

    /// One that is left out with everything in it.
    pub(crate) const fn no_effect(name: &'static str, why: &'static str) -> Self {
        Self { name, treatment: Treatment::NoEffect(why), attributes: &[], children: &[] }
    }

    /// One that cannot be taken over.
    pub(crate) const fn refused(name: &'static str, what_to_do: &'static str) -> Self {
        Self { name, treatment: Treatment::Refused(what_to_do), attributes: &[], children: &[] }
    }
}
