//! Traces over OTLP: a span for each call and each computation of the workers, never for a step. Where the collector
//! does not answer, spans are lost and nobody waits.

use anyhow::{Context as _, Result};
use opentelemetry::KeyValue;
use opentelemetry::trace::TracerProvider as _;
use opentelemetry_otlp::{SpanExporter, WithExportConfig as _};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::SdkTracerProvider;
use tracing::{Level, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::registry::LookupSpan;

use crate::core::workers::SPANS;

/// Sends what is left when it is dropped.
pub(crate) struct Export(SdkTracerProvider);

impl Drop for Export {
    fn drop(&mut self) {
        // A collector that is gone has missed it.
        let _ = self.0.shutdown();
    }
}

/// What makes spans of traces and sends them to `endpoint`, `http://host:port`. Within a runtime, which sends them.
pub(crate) fn layer<S>(endpoint: &str) -> Result<(impl Layer<S>, Export)>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
{
    let exporter = SpanExporter::builder().with_tonic().with_endpoint(endpoint).build();
    let exporter = exporter.with_context(|| format!("telemetry.otlp `{endpoint}`"))?;
    let version = KeyValue::new("service.version", env!("CARGO_PKG_VERSION"));
    let resource = Resource::builder().with_service_name("plantd").with_attribute(version);
    let provider = SdkTracerProvider::builder()
        .with_batch_exporter(exporter)
        .with_resource(resource.build())
        .build();
    let layer = tracing_opentelemetry::layer()
        .with_tracer(provider.tracer("plantd"))
        .with_filter(Targets::new().with_target(SPANS, Level::TRACE));
    Ok((layer, Export(provider)))
}
