"""Network addresses."""

from ipaddress import IPv4Address, IPv6Address, ip_address


def as_address(host: str) -> IPv4Address | IPv6Address | None:
    """None if the host is a name."""
    try:
        return ip_address(host)
    except ValueError:
        return None


def is_loopback(host: str) -> bool:
    """Whether only programs on this machine reach an address."""
    address = as_address(host)
    return host == "localhost" or (address is not None and address.is_loopback)
