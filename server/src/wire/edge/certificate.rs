//! What a client's certificate says of whom it belongs to. That it is genuine was found out by TLS.

use std::time::{Duration, SystemTime};

use x509_parser::extensions::GeneralName;
use x509_parser::prelude::{FromDer as _, X509Certificate};

/// A client's certificate.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Certificate {
    /// Common name of the subject, then its alternative names.
    pub names: Vec<String>,
    /// When it is over.
    pub expires: SystemTime,
}

impl Certificate {
    /// Reads a certificate in DER. None if it is no certificate.
    pub fn read(der: &[u8]) -> Option<Self> {
        let (_, certificate) = X509Certificate::from_der(der).ok()?;
        let common = certificate.subject().iter_common_name();
        let mut names: Vec<String> =
            common.filter_map(|name| name.as_str().ok().map(str::to_owned)).collect();
        // Alternative names that cannot be read are none.
        if let Ok(Some(alternative)) = certificate.subject_alternative_name() {
            names.extend(alternative.value.general_names.iter().filter_map(|name| match name {
                GeneralName::DNSName(name)
                | GeneralName::URI(name)
                | GeneralName::RFC822Name(name) => Some((*name).to_owned()),
                _ => None,
            }));
        }
        let end = u64::try_from(certificate.validity().not_after.timestamp()).unwrap_or_default();
        Some(Self { names, expires: SystemTime::UNIX_EPOCH + Duration::from_secs(end) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_end_are_read() {
        let names = ["anna.lab".to_owned(), "anna@lab.example".to_owned()];
        let mut parameters = rcgen::CertificateParams::new(names).unwrap();
        parameters.distinguished_name.push(rcgen::DnType::CommonName, "anna");
        parameters.not_after = rcgen::date_time_ymd(2090, 1, 2);
        let key = rcgen::KeyPair::generate().unwrap();
        let der = parameters.self_signed(&key).unwrap();
        let read = Certificate::read(der.der()).unwrap();
        assert!(read.names.iter().any(|name| name == "anna"), "{read:?}");
        assert!(read.names.iter().any(|name| name == "anna.lab"), "{read:?}");
        let since = read.expires.duration_since(SystemTime::UNIX_EPOCH).unwrap();
        assert_eq!(since.as_secs(), 3_786_998_400);
        assert_eq!(Certificate::read(b"nonsense"), None);
    }
}
