"""Scripts that complete jsecon's words, in the shells themselves."""

import shutil
import subprocess

import pytest

from jsecon.app import cli

TRY = """
source {script}
COMP_WORDS=({words}) COMP_CWORD={at} COMPREPLY=()
$(complete -p jsecon | sed 's/.*-F \\([^ ]*\\).*/\\1/') jsecon "${{COMP_WORDS[{at}]}}" ""
echo "${{COMPREPLY[*]}}"
"""


def _shell(name):
    if shutil.which(name) is None:
        pytest.skip(f"no {name} here")
    return name


@pytest.fixture
def script(tmp_path, capsys):
    def made(shell):
        path = tmp_path / f"jsecon.{shell}"
        assert cli.main(["completion", shell]) == 0
        path.write_text(capsys.readouterr().out)
        return path

    return made


@pytest.mark.parametrize(("words", "expected"), [
    (["ru"], {"run"}), (["run", "--gra"], {"--granularity"}),
    (["run", "x", "--granularity", ""], {"fine", "medium", "coarse"}),
    (["query", "x", "--by", "sil"], {"silhouette"}), (["completion", ""], {"bash", "zsh", "fish"}),
    (["run", "som"], {"somewhere", "some.safetensors"}), (["query", "so"], {"somewhere", "some.safetensors"}),
])  # fmt: skip
def test_bash_completes(script, tmp_path, words, expected):
    (tmp_path / "somewhere").mkdir()
    (tmp_path / "some.safetensors").touch()
    line = " ".join(f"'{word}'" for word in ["jsecon", *words])
    text = TRY.format(script=script("bash"), words=line, at=len(words))
    found = subprocess.run([_shell("bash"), "-c", text], capture_output=True, text=True, cwd=tmp_path, check=True)
    assert (set(found.stdout.split()), found.stderr) == (expected, "")


def test_every_verb_is_completed(script):
    text = TRY.format(script=script("bash"), words="jsecon ''", at=1)
    found = subprocess.run([_shell("bash"), "-c", text], capture_output=True, text=True, check=True)
    assert set(cli.VERB_NAMES) <= set(found.stdout.split())


def test_fish_completes(script):
    text = f"source {script('fish')}; complete -C 'jsecon ru'; complete -C 'jsecon run x --gra'"
    found = subprocess.run([_shell("fish"), "-c", text], capture_output=True, text=True, check=True)
    assert [line.split("\t")[0] for line in found.stdout.splitlines()] == ["run", "--granularity"]


def test_zsh_can_read_its_script(script):
    subprocess.run([_shell("zsh"), "-n", str(script("zsh"))], check=True)
