//! The caller of a request.

use std::net::{IpAddr, Ipv6Addr, SocketAddr};

use grasp_engine::Caller;
use http::Extensions;

use crate::transport::connections::Peer;

/// The caller of a request: by its token if the server checks tokens, otherwise by its address.
pub(crate) fn of(extensions: &Extensions) -> Caller {
    let by_address = || Peer::from_extensions(extensions).and_then(|peer| peer.address).map_or(Caller::Unknown, at);
    extensions.get().copied().unwrap_or_else(by_address)
}

fn at(address: SocketAddr) -> Caller {
    Caller::Address(match address.ip().to_canonical() {
        IpAddr::V6(address) => IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() >> 64 << 64)),
        address => address,
    })
}

#[cfg(test)]
mod tests {

    #[test]
    fn a_caller_by_address_is_an_ipv4_address_or_an_ipv6_network() {
        let at = |address: &str| super::at(address.parse().unwrap());
        assert_eq!(at("10.0.0.1:1000"), at("10.0.0.1:2000"));
        assert_eq!(at("10.0.0.1:1000"), at("[::ffff:10.0.0.1]:1000"));
        assert_ne!(at("10.0.0.1:1000"), at("10.0.0.2:1000"));
        assert_eq!(at("[2001:db8::1]:1"), at("[2001:db8::ffff:2]:1"));
        assert_ne!(at("[2001:db8::1]:1"), at("[2001:db8:0:1::1]:1"));
    }
}
