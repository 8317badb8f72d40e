//! MQTT traffic counters: bytes, packets, messages and acknowledgements, for each connection and in
//! total. They use relaxed atomics; a reader sees figures that may be some packets apart from each
//! other.

use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::task::{Context, Poll};

use task_proto::api::{MqttTraffic, Traffic};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

/// The counters of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Count {
    BytesIn,
    BytesOut,
    PacketsIn,
    PacketsOut,
    MessagesIn,
    MessagesOut,
    AcksIn,
    AcksOut,
}

#[derive(Default)]
struct Counters([AtomicU64; 8]);

impl Counters {
    fn add(&self, count: Count, number: u64) {
        self.0[count as usize].fetch_add(number, Ordering::Relaxed);
    }

    fn read(&self) -> Traffic {
        let of = |count: Count| self.0[count as usize].load(Ordering::Relaxed);
        Traffic {
            bytes_in: of(Count::BytesIn),
            bytes_out: of(Count::BytesOut),
            packets_in: of(Count::PacketsIn),
            packets_out: of(Count::PacketsOut),
            messages_in: of(Count::MessagesIn),
            messages_out: of(Count::MessagesOut),
            acks_in: of(Count::AcksIn),
            acks_out: of(Count::AcksOut),
        }
    }
}

/// One connection's figures. They count towards the totals from the moment when the client is
/// known: the watchdog's never do.
#[derive(Default)]
pub(super) struct Meter {
    own: Counters,
    totals: OnceLock<Arc<Counters>>,
}

impl Meter {
    pub(super) fn add(&self, count: Count, number: u64) {
        self.own.add(count, number);
        if let Some(totals) = self.totals.get() {
            totals.add(count, number);
        }
    }

    pub(super) fn read(&self) -> Traffic {
        self.own.read()
    }
}

/// The figures of all connections since the front began.
#[derive(Default)]
pub(super) struct Totals {
    traffic: Arc<Counters>,
    accepted: AtomicU64,
    refused: AtomicU64,
    messages_refused: AtomicU64,
}

impl Totals {
    /// Counts an admitted client.
    pub(super) fn accept(&self, meter: &Meter) {
        self.accepted.fetch_add(1, Ordering::Relaxed);
        self.add_to_totals(meter);
    }

    /// Counts a refused client; without a meter the client was refused before any byte was read.
    pub(super) fn refuse(&self, meter: Option<&Meter>) {
        self.refused.fetch_add(1, Ordering::Relaxed);
        if let Some(meter) = meter {
            self.add_to_totals(meter);
        }
    }

    /// Counts a refused message: its topic is not allowed, or the message could not be stored.
    pub(super) fn refuse_message(&self) {
        self.messages_refused.fetch_add(1, Ordering::Relaxed);
    }

    /// The figures, without those that only other modules know.
    pub(super) fn read(&self) -> MqttTraffic {
        MqttTraffic {
            connections_accepted: self.accepted.load(Ordering::Relaxed),
            connections_refused: self.refused.load(Ordering::Relaxed),
            messages_refused: self.messages_refused.load(Ordering::Relaxed),
            all: self.traffic.read(),
            ..MqttTraffic::default()
        }
    }

    /// A connection's own task calls this, so nothing is counted between its lines.
    fn add_to_totals(&self, meter: &Meter) {
        let Traffic { bytes_in, bytes_out, packets_in, packets_out, .. } = meter.read();
        let so_far = [
            (Count::BytesIn, bytes_in),
            (Count::BytesOut, bytes_out),
            (Count::PacketsIn, packets_in),
            (Count::PacketsOut, packets_out),
        ];
        if meter.totals.set(self.traffic.clone()).is_ok() {
            for (count, number) in so_far {
                self.traffic.add(count, number);
            }
        }
    }
}

/// A stream that counts its bytes.
pub(super) struct Metered<S> {
    pub(super) stream: S,
    pub(super) meter: Arc<Meter>,
}

impl<S: AsyncRead + Unpin> AsyncRead for Metered<S> {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<std::io::Result<()>> {
        let this = self.get_mut();
        let before = buffer.filled().len();
        let polled = Pin::new(&mut this.stream).poll_read(context, buffer);
        this.meter.add(Count::BytesIn, (buffer.filled().len() - before) as u64);
        polled
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Metered<S> {
    fn poll_write(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<std::io::Result<usize>> {
        let this = self.get_mut();
        let polled = Pin::new(&mut this.stream).poll_write(context, bytes);
        if let Poll::Ready(Ok(written)) = polled {
            this.meter.add(Count::BytesOut, written as u64);
        }
        polled
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[std::io::IoSlice<'_>],
    ) -> Poll<std::io::Result<usize>> {
        let this = self.get_mut();
        let polled = Pin::new(&mut this.stream).poll_write_vectored(context, slices);
        if let Poll::Ready(Ok(written)) = polled {
            this.meter.add(Count::BytesOut, written as u64);
        }
        polled
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_flush(context)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_shutdown(context)
    }
}
