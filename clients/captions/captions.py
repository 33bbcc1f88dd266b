"""Turns free captions into JSON lines for `roomcast narrate`, by a language model in a GGUF file under a grammar of llama.cpp.

    camera-captions | python captions.py --model MODEL.gguf --room kitchen --room hallway | roomcast narrate - --name camera

Each line of standard input is a caption. The grammar admits one JSON object or `none`, so no output of the model is a malformed line, and
none sets presence: the daemon gets actions only. Needs `pip install llama-cpp-python`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

#: A language model: the text that follows a prompt under a grammar.
Model = Callable[[str, str], str]

#: Longest caption in characters; the rest is cut.
CAPTION_CHARS = 500


def grammar(rooms: Iterable[str]) -> str:
    """The grammar of an answer in llama.cpp's notation, with the rooms of the map."""
    names = [json.dumps(room.lower()) for room in rooms]
    place = f'(" in the " ({" | ".join(names)}))?' if names else '""'
    return "\n".join(
        [
            'root ::= " "? ("none" | object)',
            'object ::= "{\\"text\\": \\"They " words place ".\\"" count? "}"',
            "words ::= [a-z] [a-z' -]{1,100}",
            f"place ::= {place}",
            'count ::= ", \\"count\\": " [2-8]',
        ]
    )


def line_of(answer: str) -> str | None:
    """The JSON line of an answer; None for `none` and for anything that the grammar does not admit."""
    try:
        read = json.loads(answer.strip())
    except json.JSONDecodeError:
        return None
    if not isinstance(read, dict) or not isinstance(read.get("text"), str) or set(read) - {"text", "count"}:
        return None
    # The kind says that the text is no presence form, whatever the caption says.
    return json.dumps({"kind": "device", **read})


def lines(captions: Iterable[str], model: Model, prompt: str, rooms: Iterable[str] = ()) -> Iterator[str]:
    """The JSON lines of captions."""
    rules = grammar(rooms)
    for caption in captions:
        caption = " ".join(caption.split())[:CAPTION_CHARS]
        if caption and (line := line_of(model(prompt.replace("{caption}", caption), rules))):
            yield line


def load(path: str) -> Model:
    """A model of llama.cpp."""
    from llama_cpp import Llama, LlamaGrammar

    llama = Llama(model_path=path, n_ctx=2048, verbose=False)

    def answer(prompt: str, rules: str) -> str:
        made = llama(prompt, grammar=LlamaGrammar.from_string(rules, verbose=False), max_tokens=64, temperature=0, stop=["\n"])
        return str(made["choices"][0]["text"])

    return answer


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", 1)[0])
    parser.add_argument("--model", required=True, help="a GGUF file")
    parser.add_argument("--prompt", default=Path(__file__).with_name("prompt.txt"), type=Path, help="a file with {caption} in it")
    parser.add_argument("--room", action="append", default=[], help="a room of the map; `roomcast scene show` lists them")
    given = parser.parse_args()
    model, prompt = load(given.model), given.prompt.read_text()
    for line in lines(sys.stdin, model, prompt, given.room):
        print(line, flush=True)


if __name__ == "__main__":
    main()
