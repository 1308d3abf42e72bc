"""Owns the bridge, the kernel's forwarding switches and what the cluster's network leaves behind. Needs root."""

import ipaddress
import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from .errors import LabError
from .process import write_whole
from .settings import BRIDGE, BRIDGE_MAC, CNI_NETWORK, HOST_ADDRESS, POD_NETWORK, SERVICE_NETWORK, Settings

# Forwarding for Pods; the second makes the answers of a Pod behind a Service pass the address translation.
SWITCHES = ("net/ipv4/ip_forward", "net/bridge/bridge-nf-call-iptables")
CNI_CACHE = Path("/var/lib/cni/results")


def run(*argv: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(argv, capture_output=True, text=True, check=False)


def must(*argv: str) -> str:
    done = run(*argv)
    if done.returncode != 0:
        raise LabError(
            f"`{' '.join(argv)}` failed ({done.stderr.strip()[:200]}): the lab needs root and the kernel's bridge support"
        )
    return done.stdout


def up(settings: Settings) -> None:
    """Makes the bridge with the machine's address on it, and switches forwarding on, remembering how it was."""
    if not Path(f"/sys/class/net/{BRIDGE}").exists():
        refuse_overlap()
        must("ip", "link", "add", BRIDGE, "address", BRIDGE_MAC, "type", "bridge")
    if HOST_ADDRESS not in run("ip", "-4", "-o", "address", "show", "dev", BRIDGE).stdout:
        must("ip", "address", "add", f"{HOST_ADDRESS}/{POD_NETWORK.rpartition('/')[2]}", "dev", BRIDGE)
    must("ip", "link", "set", BRIDGE, "up")
    if shutil.which("modprobe"):
        run("modprobe", "-q", "br_netfilter")
    remember_switches(settings)
    for switch in SWITCHES:
        set_switch(switch, "1")


def refuse_overlap() -> None:
    """Raises if a network of this machine has addresses that the lab uses."""
    ours = [ipaddress.ip_network(POD_NETWORK), ipaddress.ip_network(SERVICE_NETWORK)]
    for link in json.loads(must("ip", "-4", "-j", "address", "show")):
        for address in link.get("addr_info", []):
            network = ipaddress.ip_network(f"{address['local']}/{address['prefixlen']}", strict=False)
            if any(network.overlaps(mine) for mine in ours):
                raise LabError(
                    f"the interface {link['ifname']} has {network}, which the lab uses: take that interface down first"
                )


def remember_switches(settings: Settings) -> None:
    """Keeps the switches' first values, so that `down` can put them back."""
    file = settings.run / "switches.json"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, json.dumps({switch: read_switch(switch) for switch in SWITCHES}))


def read_switch(switch: str) -> str | None:
    try:
        return (Path("/proc/sys") / switch).read_text().strip()
    except OSError:
        return None


def set_switch(switch: str, value: str) -> None:
    place = Path("/proc/sys") / switch
    if place.exists() and read_switch(switch) != value:
        place.write_text(value)


def down(settings: Settings) -> None:
    """Removes the bridge, our veths, the tables and chains of kube-proxy and of our CNI network; puts the switches back."""
    for link in our_veths(run("ip", "-j", "link", "show", "master", BRIDGE).stdout):
        run("ip", "link", "delete", link)
    run("ip", "link", "delete", BRIDGE)
    remove_proxy_tables()
    remove_masquerading()
    for result in list(CNI_CACHE.glob(f"{CNI_NETWORK}-*-eth0")):
        pod = result.name.removeprefix(f"{CNI_NETWORK}-").removesuffix("-eth0")
        (CNI_CACHE / f"cni-loopback-{pod}-lo").unlink(missing_ok=True)
        result.unlink(missing_ok=True)
    file = settings.run / "switches.json"
    try:
        before: dict[str, str | None] = json.loads(file.read_text())
    except (OSError, ValueError):
        return
    for switch, value in before.items():
        if switch in SWITCHES and value is not None:
            set_switch(switch, value)
    file.unlink()


def remove_proxy_tables() -> None:
    """Removes kube-proxy's tables, if there are any."""
    if shutil.which("nft"):
        for family in ("ip", "ip6"):
            run("nft", "delete", "table", family, "kube-proxy")


def our_veths(links: str) -> list[str]:
    """The names in the output of `ip -j link show master <bridge>`."""
    try:
        return [link["ifname"] for link in json.loads(links or "[]") if "ifname" in link]
    except ValueError:
        return []


def remove_masquerading() -> None:
    """Removes the rules that the CNI plugin made for Pods that went without a farewell."""
    if shutil.which("iptables-save") is None:
        return
    for command in masquerade_removals(run("iptables-save", "-t", "nat").stdout):
        run("iptables", "-w", "-t", "nat", *command)


def masquerade_removals(rules: str) -> list[list[str]]:
    """The iptables arguments that remove what belongs to our CNI network from the output of `iptables-save -t nat`.

    The plugin's rules carry a comment with the network's name; each jumps to a chain of one Pod.
    """
    mark = f'name: \\"{CNI_NETWORK}\\"'
    found = [line for line in rules.splitlines() if mark in line]
    chains = {match.group(1) for line in found if (match := re.match(r"-A (CNI-[0-9a-f]+) ", line))}
    jumps = [line for line in found if line.startswith("-A POSTROUTING")]
    removals = [["-D", "POSTROUTING", *jump_arguments(line)] for line in jumps]
    for chain in sorted(chains):
        removals += [["-F", chain], ["-X", chain]]
    return removals


def jump_arguments(line: str) -> list[str]:
    """A rule of iptables-save as arguments, its quoted comment in one piece."""
    parts = re.findall(r'"((?:[^"\\]|\\.)*)"|(\S+)', line)
    words = [quoted.replace('\\"', '"') if quoted else plain for quoted, plain in parts]
    return words[2:]


@dataclass(frozen=True)
class Holder:
    """Who listens at a port."""

    text: str
    # None: the kernel does not show whose it is.
    pid: int | None = None


def holder_of(address: str, port: int) -> Holder | None:
    """Who listens at a port so that `address`:`port` can't be had: `program (pid N)`; None if it is free."""
    listing = run("ss", "-Hlntp", "sport", "=", f":{port}").stdout
    for line in listing.splitlines():
        fields = line.split()
        local = fields[3].rpartition(":")[0].strip("[]") if len(fields) > 3 else ""
        if local in (address, "0.0.0.0", "*", "::"):
            match = re.search(r'\("([^"]+)",pid=(\d+)', line)
            if match:
                return Holder(f"{match.group(1)} (pid {match.group(2)})", int(match.group(2)))
            return Holder("another process")
    return None
