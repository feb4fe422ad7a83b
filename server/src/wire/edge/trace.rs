//! Spans of calls. They lead somewhere where the feature `otlp` is built in and configured; otherwise nothing is made
//! of them.

use tonic::codegen::http::HeaderMap;
use tracing::{Span, field};

use crate::core::workers::SPANS;

/// The span of a call, which goes on with the trace of the caller if its headers name one.
pub(super) fn of_call(method: &'static str, headers: &HeaderMap) -> Span {
    let span = tracing::trace_span!(
        target: SPANS,
        "rpc",
        otel.name = method,
        otel.kind = "server",
        rpc.system = "grpc",
        rpc.method = method,
        rpc.code = field::Empty,
    );
    #[cfg(feature = "otlp")]
    if !span.is_disabled() {
        go_on(&span, headers);
    }
    #[cfg(not(feature = "otlp"))]
    let _ = headers;
    span
}

/// Puts the span under the caller's, by the header `traceparent` of W3C.
#[cfg(feature = "otlp")]
fn go_on(span: &Span, headers: &HeaderMap) {
    use opentelemetry::propagation::{Extractor, TextMapPropagator as _};
    use opentelemetry_sdk::propagation::TraceContextPropagator;
    use tracing_opentelemetry::OpenTelemetrySpanExt as _;

    struct Headers<'a>(&'a HeaderMap);

    impl Extractor for Headers<'_> {
        fn get(&self, key: &str) -> Option<&str> {
            self.0.get(key)?.to_str().ok()
        }

        fn keys(&self) -> Vec<&str> {
            self.0.keys().map(|key| key.as_str()).collect()
        }
    }

    // A header that is none begins a trace of its own.
    let _ = span.set_parent(TraceContextPropagator::new().extract(&Headers(headers)));
}
