"""``tpm-gym view``: one line, this computer only, a quiet end, and a page without a server."""

import re
import signal
import subprocess
import threading
import urllib.request
from contextlib import closing
from dataclasses import replace
from functools import partial

import psutil
import pytest
from processes import TPM_GYM

from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism import PAPER_TPM, Mount
from tpm_gym.viewer import ViewConfig, open_viewer, run
from tpm_gym.viewer.export import export


@pytest.fixture
def command():
    words = [*TPM_GYM, "view", "--port", "0", "--machine", "wide"]
    pipes = dict.fromkeys(("stdout", "stderr"), subprocess.PIPE)
    # A shell's job in the background is started with SIGINT ignored.
    heard = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(words, text=True, preexec_fn=heard, **pipes) as process:
        yield process
        process.kill()


def test_the_command_tells_its_address_serves_this_computer_only_and_ends_quietly(command):
    line = command.stdout.readline()
    address = re.search(r"http://127\.0\.0\.1:\d+", line)[0]
    with urllib.request.urlopen(address) as page:
        assert b"<html" in page.read().lower()
    listening = psutil.Process(command.pid).net_connections("inet")
    assert {c.laddr.ip for c in listening if c.status == psutil.CONN_LISTEN} == {"127.0.0.1"}
    command.send_signal(signal.SIGINT)
    out, err = command.communicate(timeout=30)
    assert (out, err, command.returncode) == ("", "", 0)


def test_an_export_is_one_page_with_an_episode(tmp_path, capsys):
    run(ViewConfig(export=tmp_path / "new" / "folder"))
    page = tmp_path / "new" / "folder" / "index.html"
    shown = capsys.readouterr()
    assert shown.out == f"{page}\n"
    assert shown.err.startswith("playing an episode for the page ...\n")
    assert [file.name for file in page.parent.iterdir()] == ["index.html"]
    text = page.read_text(encoding="utf-8")
    assert "__VISER_EMBED_DATA__=" in text
    assert page.stat().st_size < 3e6
    run(ViewConfig(export=page.parent))  # an earlier page is replaced
    assert not re.search(r"""<(script|link|img)[^>]*(src|href)=["']?https?:""", text)


def test_an_export_replaces_no_page_of_others_and_no_file(tmp_path):
    page = tmp_path / "index.html"
    page.write_text("<html>mine</html>")
    for folder in (tmp_path, page):
        with pytest.raises(ConfigurationError, match="export"):
            run(ViewConfig(export=folder))
    assert page.read_text() == "<html>mine</html>"


def test_a_machine_without_the_task_leaves_no_folder_and_no_server(tmp_path):
    high, before = replace(PAPER_TPM, mount=Mount(height=1.5)), threading.active_count()
    with pytest.raises(ConfigurationError, match="cup"):
        export(tmp_path / "page", high)
    assert not any(tmp_path.iterdir())
    assert threading.active_count() == before


def test_addresses_of_version_6_are_in_brackets():
    try:
        viewer = open_viewer(host="::1", port=0)
    except ConfigurationError:
        pytest.skip("no IPv6 here")
    with closing(viewer), urllib.request.urlopen(viewer.address) as page:
        assert b"<html" in page.read().lower()
