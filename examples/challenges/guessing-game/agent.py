"""A participant's agent: it halves the range with each guess."""
import json, os, urllib.request

def post(path, document):
    address = f"http://{os.environ['EVALUATOR_ADDRESS']}{path}"
    with urllib.request.urlopen(address, json.dumps(document).encode()) as answer:
        return json.load(answer)

session = post("/session", {})["session"]
low, high, over = 1, 1000, False
while not over:
    number = (low + high) // 2
    answer = post("/guess", {"session": session, "number": number})
    hint, over = answer["hint"], answer["over"]
    low, high = {"higher": (number + 1, high), "lower": (low, number - 1), "found": (1, 1000)}[hint]
    print(f"{number}: {hint}", flush=True)
