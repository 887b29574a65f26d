//! Addresses of servers.

/// The port of graspd where an address has none.
const PORT: u16 = 50051;

/// The URI of an address: `HOST`, `HOST:PORT`, either with `http://` or `https://`, or `unix:PATH`.
pub(crate) fn uri(address: &str, has_tls: bool) -> Result<String, String> {
    if address.starts_with("unix:") {
        return Ok(address.to_owned());
    }
    let (scheme, rest) = address.split_once("://").unwrap_or(("http", address));
    if !["http", "https"].contains(&scheme) {
        return Err(format!("the address begins with {scheme}://, must begin with http://, https:// or unix:"));
    }
    let (authority, path) = rest.find('/').map_or((rest, ""), |at| rest.split_at(at));
    let has_port = authority.rsplit_once(']').map_or(authority, |(_, after)| after).contains(':');
    let (host, port) = if has_port { authority.rsplit_once(':').unwrap_or((authority, "")) } else { (authority, "") };
    let port = match port.parse() {
        Ok(port) => port,
        Err(_) if port.is_empty() => PORT,
        Err(_) => return Err(format!("the port of the address is {port}, must be from 1 to 65535")),
    };
    if host.is_empty() {
        return Err(format!("the address has no host; an example is 127.0.0.1:{PORT}"));
    }
    // With `http://`, tonic would not use TLS.
    let scheme = if has_tls { "https" } else { scheme };
    Ok(format!("{scheme}://{host}:{port}{path}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_have_a_port_and_a_scheme() {
        let addresses = [
            ("127.0.0.1", "http://127.0.0.1:50051"),
            ("127.0.0.1:", "http://127.0.0.1:50051"),
            ("http://robot:1", "http://robot:1"),
            ("https://robot", "https://robot:50051"),
            ("[::1]", "http://[::1]:50051"),
            ("[::1]:7", "http://[::1]:7"),
            ("unix:/run/graspd.sock", "unix:/run/graspd.sock"),
        ];
        for (address, expected) in addresses {
            assert_eq!(uri(address, false).as_deref(), Ok(expected));
        }
        assert_eq!(uri("http://robot:1", true).as_deref(), Ok("https://robot:1"));
        let refused = [
            ("127.0.0.1:99999", "the port of the address is 99999"),
            ("robot:x", "the port of the address is x"),
            ("ftp://robot:1", "begins with ftp://"),
            (":50051", "has no host"),
        ];
        for (address, part) in refused {
            let reason = uri(address, false).unwrap_err();
            assert!(reason.contains(part), "{address}: {reason}");
        }
    }
}
