use grasp_proto::FieldError;

/// Maximum length of a request id and a frame id, bytes. Both are echoed; the request id is also logged.
const MAX_ID: usize = 256;

/// Frame id and time stamp of a volume or of views, echoed in the response.
#[derive(Clone, Default)]
pub(crate) struct FrameStamp {
    pub frame_id: String,
    pub stamp: Option<prost_types::Timestamp>,
}

impl FrameStamp {
    /// Checks the frame id, which is in the field `field`.
    pub fn checked(
        field: &'static str,
        frame_id: String,
        stamp: Option<prost_types::Timestamp>,
    ) -> Result<Self, FieldError> {
        check_id(field, &frame_id)?;
        Ok(Self { frame_id, stamp })
    }
}

/// Checks the length of a request id or a frame id.
pub(crate) fn check_id(field: &'static str, id: &str) -> Result<(), FieldError> {
    if id.len() <= MAX_ID {
        return Ok(());
    }
    Err(FieldError::new(field, format_args!("{} bytes long", id.len()), format_args!("must be at most {MAX_ID}")))
}
