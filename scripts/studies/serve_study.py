#!/usr/bin/env python
"""Load `stcal-sfm measure --serve` with four clients: three follow the target, one sends rubbish.

The clients are processes of this script that send simulated photographs of 2 megapixels, a sequence each, at an even
rate over connections that stay open; the fourth sends what is no photograph, what is too large, what ends too early and
broken requests, as many a second as each of the others. Lost is what gets no answer, or another image's. Memory is that
of the server and its processes, pages that they share counted once, at the tenth and at the last part of the time.

With ``--hostile`` one client follows the target, undisturbed for a quarter of the time, and then beside one that
attacks: connections that send nothing, photographs whose sender leaves, bytes one by one, uploads of 60 MB that lack
the last byte, ones that are too large, broken and smuggled requests, and answers that are not read. Ends with 1 where
an answer is lost, takes longer than 2 s (on a machine that is busy otherwise, one search may take that long), or memory
grows beyond the documented budget: the images under way, and what is read at a time from each connection.
"""

import argparse
import http.client
import json
import multiprocessing
import os
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from stcal.io.files import json_text
from stcal.sfm.adjust.calibration import AdjustOptions
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.file import FacesFile
from stcal.sfm.measurement.serve import CHUNK_BYTES, CONNECTIONS, HELD_BYTES
from stcal.synthetic.dataset import write_dataset
from stcal.synthetic.scene import SceneOptions, make_scene
from tests.support.film import filmed

FRAMES = 40
"""Of a client's film, sent forth and back."""
SIZE = 1728, 1152
CLIENTS = 3
PATIENCE_S = 30.0
LATE_START_S = 1.0
TARGET_SIGMA_MM = 0.002


def film(folder: Path, client: int) -> list[tuple[str, bytes]]:
    """Name and content of a client's photographs; another view and motion for each."""
    scene = filmed(make_scene(SceneOptions(width=SIZE[0], height=SIZE[1])), "12", FRAMES, seed=client, view=client)
    if not (folder / "truth.json").exists():
        write_dataset(folder, scene, image_format="jpg")
    return [(path.name, path.read_bytes()) for path in sorted((folder / "images" / "12").iterdir())]


def write_faces(path: Path) -> None:
    """The target as it is, with a σ of its circles like that of a run."""
    scene = make_scene(SceneOptions(width=SIZE[0], height=SIZE[1]))
    circles = scene.circles_target
    target = CalibratedTarget(
        reference_face=scene.target.faces[0].id,
        target_from_face=scene.target_from_face,
        circles=circles,
        target_from_group={},
        scale_sigma=1e-5,
        circle_covariance={label: TARGET_SIGMA_MM**2 * np.eye(3) for label in circles},
        covariance_mm2=TARGET_SIGMA_MM**2 * np.eye(3 * len(circles)),
    )
    path.write_text(
        json_text(FacesFile.of(target, scene.target, AdjustOptions(target.reference_face), 1.0)), encoding="utf-8"
    )


def due(start: float, rate: float, i: int) -> float:
    """Wait until the i-th image's time; that time."""
    at = start + i / rate
    time.sleep(max(0.0, at - time.time()))
    return at


def follow(client: int, port: int, frames: list, start: float, seconds: float, rate: float) -> dict:
    """Send photographs at a rate; latencies in s from when each was due and was sent, and what was lost or refused."""
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    order = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]
    latencies, taken, lost, refused, none, i = [], [], 0, 0, 0, 0
    while (at := due(start, rate, i)) < start + seconds:
        name, data = frames[order[i % len(order)]]
        name = f"client{client}/{i}/{name}"
        sent = time.time()
        try:
            line.request("POST", f"/measure?name={name}&sequence=client{client}", body=data)
            answer = line.getresponse()
            content = json.loads(answer.read())
            if answer.status == 200:
                lost += content["images"][0]["image"] != name
            else:
                refused += answer.status in (400, 500, 503)
                none += answer.status == 422
        except (OSError, http.client.HTTPException, ValueError):
            lost += 1
            line.close()
        latencies.append(time.time() - at)
        taken.append(time.time() - sent)
        i += 1
    return {"sent": i, "latencies": latencies, "taken": taken, "lost": lost, "refused": refused, "without": none}


def rubbish(port: int, frames: list, start: float, seconds: float, rate: float) -> dict:
    """What no server should meet; every request that is one gets an answer that is no pose."""
    rng = random.Random(1)
    photograph = frames[0][1]
    kinds = ["noise", "cut", "too large", "broken", "left", "other size", "empty"]
    lost, i = 0, 0
    while due(start, rate, i) < start + seconds:
        kind = kinds[i % len(kinds)]
        body = {
            "noise": rng.randbytes(200_000),
            "cut": photograph[: len(photograph) // 2],
            "too large": b"",
            "other size": OTHER_SIZE,
            "empty": b"",
        }.get(kind, b"")
        length = 10**12 if kind == "too large" else len(body)
        head = f"POST /measure HTTP/1.1\r\nHost: x\r\nContent-Length: {length}\r\n\r\n".encode()
        try:
            with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as line:
                if kind == "left":  # in the middle of its own photograph
                    line.sendall(head.replace(b"Content-Length: 0", b"Content-Length: 500000") + photograph[:1000])
                else:
                    line.sendall(rng.randbytes(300) + b"\r\n\r\n" if kind == "broken" else head + body)
                    answer = line.recv(1 << 16)
                    lost += kind != "broken" and not answer.startswith(b"HTTP/1.1 4")
        except OSError:
            lost += 1
        i += 1
    return {"sent": i, "lost": lost}


QUIET, MOST_S = 0.25, 2.0
"""Share of the time without an attack; longest time to an answer, s."""
IDLE, STALLED, SLOW, DEAF = 100, 20, 30, 10
"""Number of connections of each kind that are held open."""
STALLED_BYTES = 60_000_000
WHOLE = b"POST /measure HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n"
ASKED = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
HEAD = b" HTTP/1.1\r\nHost: x\r\n"
SMUGGLED = (
    b"GET /" + HEAD + b"Content-Length: 44\r\n\r\n",
    b"GET /" + HEAD + b"Content-Length: 44\r\nContent-Length: 45\r\n\r\n",
    b"GET /" + HEAD + b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    b"POST /measure" + HEAD + b"Content-Length: 4\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    b"POST /measure" + HEAD + b"Transfer-Encoding: chunked\r\nContent-Length: 4\r\n\r\n1;a=b\r\nx\r\n0\r\n\r\n",
    b"POST /measure" + HEAD + b"Transfer-Encoding : chunked\r\nContent-Length: 0\r\n\r\n",
    b"POST /measure" + HEAD + b"Content-Length: 0, 44\r\n\r\n",
)
"""Heads behind which another server could find a second request."""


def attack(port: int, frames: list, start: float, seconds: float, rate: float) -> dict:
    """Use up what the service has; number of requests, and of those of which a part was answered as a second one."""
    photograph, smuggled, i = frames[0][1], 0, 0
    held: dict[str, list[socket.socket]] = {"idle": [], "stalled": [], "slow": [], "deaf": []}
    kinds = ["idle", "idle", "left", "slow", "stalled", "smuggled", "broken", "left", "oversized", "deaf"]
    while due(start, rate, i) < start + seconds:
        kind = kinds[i % len(kinds)]
        kind = "idle" if kind == "stalled" and len(held[kind]) == STALLED else kind
        i += 1
        try:
            line = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
            if kind in held:
                if kind == "stalled":
                    line.sendall(WHOLE % STALLED_BYTES + bytes(STALLED_BYTES - 1))
                if kind == "deaf":  # what is answered is never read
                    line.sendall(100 * ASKED)
                held[kind].append(line)
            else:
                sent = {"left": WHOLE % len(photograph) + photograph, "oversized": WHOLE % 10**12 + bytes(10**6)}
                sent |= {"smuggled": SMUGGLED[i % len(SMUGGLED)] + ASKED, "broken": random.Random(i).randbytes(300)}
                line.sendall(sent[kind] + (b"\r\n\r\n" if kind == "broken" else b""))
                smuggled += kind == "smuggled" and answers_on(line) > 1
                line.close()
        except OSError:
            line.close()
        for slow in list(held["slow"]):
            try:
                slow.send(b"P")
            except OSError:  # ended from the other side
                held["slow"].remove(slow)
        for kind, most in (("idle", IDLE), ("slow", SLOW), ("deaf", DEAF)):
            while len(held[kind]) > most:
                held[kind].pop(0).close()
    return {"sent": i, "smuggled": smuggled}


def answers_on(line: socket.socket) -> int:
    """Number of answers that come before the other side ends the connection."""
    line.settimeout(2)
    answer = b""
    while part := line.recv(1 << 16):
        answer += part
    return answer.count(b"HTTP/1.1 ")


def hostile(options, films: list, port: int, pid: int) -> bool:
    """Send beside an attacker for the time, and print what came of it; returns whether the client was served."""
    context = multiprocessing.get_context("fork")
    answers = [context.SimpleQueue() for _ in range(2)]
    start = time.time() + LATE_START_S
    quiet = options.seconds * QUIET
    jobs = [(follow, 0, port, films[0], start, options.seconds, options.rate / 10)]
    jobs.append((attack, port, films[0], start + quiet, options.seconds - quiet, options.rate))
    clients = [context.Process(target=run_client, args=(q, *job)) for q, job in zip(answers, jobs, strict=True)]
    for client in clients:
        client.start()
    memory = []
    while time.time() < start + options.seconds:
        memory.append(memory_mb(pid))
        time.sleep(0.2)
    found, attacked = (queue.get() for queue in answers)
    for client in clients:
        client.join()
    print(f"{found['sent']} photographs beside {attacked['sent']} hostile requests in {options.seconds:g} s")
    print(f"lost answers: {found['lost']}; refused photographs: {found['refused']}; without a pose: {found['without']}")
    early = round(QUIET * len(found["taken"]))
    before, beside = np.array(found["taken"][:early]), np.array(found["taken"][early:])
    for words, taken in (("before", before), ("beside", beside)):
        print(f"from sent to answered {words} the attack, s: median {np.median(taken):.2f}, most {taken.max():.2f}")
    late = [f"{i / (options.rate / 10):.0f}" for i in np.flatnonzero(np.array(found["taken"]) > MOST_S)]
    print(f"answers after more than {MOST_S:g} s: {len(late)}", *(f"at {second} s" for second in late[:9]))
    print(f"parts answered as second requests: {attacked['smuggled']}")
    undisturbed, most = (max(part) for part in (memory[: round(QUIET * len(memory))], memory))
    budget = (HELD_BYTES + 2 * CHUNK_BYTES * CONNECTIONS) / 1e6
    grown = most - undisturbed
    print(f"memory: {undisturbed:.0f} MB before the attack, up to {grown:.0f} MB more, {budget:.0f} MB allowed")
    bad = found["lost"] + found["refused"] + attacked["smuggled"]
    return not bad and max(found["taken"]) <= MOST_S and grown <= budget


def run_client(answers, function, *arguments) -> None:
    """In a process of its own."""
    answers.put(function(*arguments))


def memory_mb(pid: int) -> float:
    """Of a process and all that it started (``Pss``)."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from bench_run import proportional

    return proportional(pid) / 1e6


def main() -> None:
    """Render, serve, send, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=50.0, help="images a second of all clients, rubbish included")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--hostile", action="store_true", help="one client beside an attacker")
    parser.add_argument("--keep", type=Path, help="render to this folder, or take what is there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        films = [film(folder / f"client{i}", i) for i in range(CLIENTS)]
        write_faces(folder / "faces.json")
        words = ["measure", "--serve", "--port", 0, "--workers", options.workers, "--faces", folder / "faces.json"]
        words += ["--camera", folder / "client0" / "cameras.txt"]
        program = [sys.executable, "-P", "-c", "from stcal.cli.entry import main_sfm; main_sfm()", *map(str, words)]
        with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as server:
            port = int(re.search(r":(\d+)/measure", server.stdout.readline()).group(1))
            served = (hostile if options.hostile else report)(options, films, port, server.pid)
            server.send_signal(signal.SIGINT)
            print("\n".join(server.stdout.read().split("\n")[:1]))
    sys.exit(served is False)


def report(options, films: list, port: int, pid: int) -> None:
    """Send for the time, and print what came of it."""
    context = multiprocessing.get_context("fork")
    answers = [context.SimpleQueue() for _ in range(CLIENTS + 1)]
    start, rate = time.time() + LATE_START_S, options.rate / (CLIENTS + 1)
    jobs = [(follow, i, port, films[i], start, options.seconds, rate) for i in range(CLIENTS)]
    jobs.append((rubbish, port, films[0], start, options.seconds, rate))
    clients = [context.Process(target=run_client, args=(q, *job)) for q, job in zip(answers, jobs, strict=True)]
    for client in clients:
        client.start()
    time.sleep(max(0, start + options.seconds / 10 - time.time()))
    early = memory_mb(pid)
    time.sleep(max(0, start + 0.95 * options.seconds - time.time()))
    late = memory_mb(pid)
    found = [queue.get() for queue in answers]
    took = time.time() - start
    for client in clients:
        client.join()
    latency = 1e3 * np.concatenate([each["latencies"] for each in found[:CLIENTS]])
    sent = sum(each["sent"] for each in found)
    counts = {key: sum(each[key] for each in found[:CLIENTS]) for key in ("refused", "without")}
    megabytes = [np.mean([len(data) for _, data in each]) / 1e6 for each in films]
    print(
        f"{SIZE[0]}×{SIZE[1]} px, files of {', '.join(f'{v:.2f}' for v in megabytes)} MB, {options.workers} processes"
    )
    print(f"asked for {options.rate:g} a second for {options.seconds:g} s: {sent} sent, {sent / took:.1f} a second")
    print(f"photographs: {sent - found[-1]['sent']}, rubbish: {found[-1]['sent']}")
    print(f"lost answers: {sum(each['lost'] for each in found)}; refused photographs: {counts['refused']}; ", end="")
    print(f"without a pose: {counts['without']}")
    parts = [np.percentile(latency, p) for p in (50, 95, 100)]
    print("from due to answered, ms: median {:.0f}, 95 % {:.0f}, most {:.0f}".format(*parts))
    print(f"memory: {early:.0f} MB, at the end {late:.0f} MB")


OTHER_SIZE = cv2.imencode(".png", np.zeros((480, 640), np.uint8))[1].tobytes()

if __name__ == "__main__":
    main()
