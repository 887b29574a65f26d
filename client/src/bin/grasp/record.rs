//! MCAP recording for Foxglove and Rerun.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use anyhow::Context;
use mcap::Writer;
use mcap::records::MessageHeader;

use crate::messages::Message;

/// Writes each message to a channel of its own.
pub(crate) fn write(path: &Path, messages: &[Message]) -> anyhow::Result<()> {
    let file = File::create(path).with_context(|| path.display().to_string())?;
    let mut writer = Writer::new(BufWriter::new(file))?;
    for Message { topic, schema, encoding, time, data } in messages {
        let schema = writer.add_schema(&schema.name, &schema.encoding, &schema.data)?;
        let channel_id = writer.add_channel(schema, topic, encoding, &BTreeMap::new())?;
        let header = MessageHeader { channel_id, sequence: 0, log_time: *time, publish_time: *time };
        writer.write_to_known_channel(&header, data)?;
    }
    writer.finish()?;
    Ok(())
}
