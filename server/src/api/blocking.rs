use std::sync::Arc;
use std::time::Instant;

use grasp::{Code, RequestError};
use tokio::task::spawn_blocking;

/// Runs `work` on a thread for blocking tasks, to keep the async runtime's threads free. It is passed a function that
/// returns whether its result is still wanted: the call was not cancelled, and the deadline has not passed. `permit` is
/// held until the work is done, even if the call is cancelled before.
pub(crate) async fn blocking<T: Send + 'static>(
    permit: impl Send + 'static,
    deadline: Option<Instant>,
    work: impl FnOnce(&dyn Fn() -> bool) -> Result<T, RequestError> + Send + 'static,
) -> Result<T, RequestError> {
    // Dropped with this future, if the call is cancelled.
    let call = Arc::new(());
    let weak = Arc::downgrade(&call);
    let work = move || {
        let _permit = permit;
        work(&|| weak.strong_count() > 0 && deadline.is_none_or(|deadline| Instant::now() < deadline))
    };
    let done = spawn_blocking(work).await;
    drop(call);
    done.unwrap_or_else(|panic| Err(RequestError::new(Code::Internal, format!("the conversion panicked: {panic}"))))
}
