"""Words that decide what is meant, as flags: a sentence embedding alone barely tells left from right."""

from __future__ import annotations

import re

# Flag -> patterns that a whole word must match: stems with the endings that English gives them, so that another
# language's words ("tourne", "links") stay out.
_PATTERNS: dict[str, str] = {
    "left": r"left(ward|wards|hand|handed|most)?|port|(anti|counter)clockwise",
    "right": r"right(ward|wards|hand|handed|most)?|starboard|clockwise",
    "forward": r"forwards?|ahead|onwards?|forth|front|advanc(e|es|ing)",
    "back": r"back(ward|wards|ing|s|pedal|pedalling)?|revers(e|es|ing)|retreat(s|ing)?|rearwards?|rear|behind",
    "both": r"both",
    "turn": r"turn(s|ing)?|rotat(e|es|ing|ion)|spin(s|ning)?|pivot(s|ing)?|swivel(s|ling|ing)?|twirl(s|ing)?|"
    r"yaw(s|ing)?|revolv(e|es|ing)|whirl(s|ing)?|face|look",
    "side-step": r"side(s|step|steps|stepping|ways?|ward|wards)?|straf(e|es|ing)|lateral(ly)?|crab(s|wise)?|"
    r"shuffl(e|es|ing)|slid(e|es|ing)|scoot(s|ing)?",
    "diagonal": r"diagonal(s|ly)?|oblique(ly)?|slant(s|ed|ing|wise)?|aslant",
    "arc": r"arc(s|ing)?|curv(e|es|ed|ing)|veer(s|ing)?|bend(s|ing)?|circl(e|es|ing)|circular|loop(s|ing)?|"
    r"swerv(e|es|ing)|swing(s|ing)?|steer(s|ing)?|bear(s|ing)?|drift(s|ing)?|corner",
    "slow": r"slow(er|ly|s|ing)?|low|creep(s|ing)?|crawl(s|ing)?|gent(le|ly)|careful(ly)?|cautio(n|us|usly)|leisurely|"
    r"unhurried|inch(es|ing)?|ambl(e|es|ing)|calm(ly)?|easy|sneak(s|ing)?|tiptoe(s|ing)?|gradual(ly)?",
    "fast": r"fast(er)?|quick(er|ly)?|rapid(ly)?|swift(ly)?|speed(s|ing|y|ily)|hurr(y|ies|ying|ied)|run(s|ning)?|"
    r"jog(s|ging)?|rush(es|ing)?|brisk(ly)?|sprint(s|ing)?|hast(e|en|ily)|dash(es|ing)?|rac(e|es|ing)|charg(e|es|ing)",
    "stop": r"stop(s|ped|ping)?|stand(s|ing)?|halt(s|ed|ing)?|still|stay(s|ing)?|wait(s|ing)?|freez(e|es|ing)|"
    r"hold(s|ing)?|rest(s|ing)?|paus(e|es|ing)|remain(s|ing)?|idl(e|ing)|motionless|stationary|upright|ceas(e|es|ing)",
}
# Words that set a flag only where another flag is not set: "straight back", "at low speed".
_UNLESS: tuple[tuple[str, str, str], ...] = (("straight", "forward", "back"), ("speed", "fast", "slow"))
FLAGS: tuple[str, ...] = tuple(_PATTERNS)
_COMPILED = {flag: re.compile(pattern) for flag, pattern in _PATTERNS.items()}
_WORD = re.compile(r"[^\W\d_]+")
# Two words that are one: "counter-clockwise" is not clockwise, and "right now" is not a side.
_COMPOUNDS = ((re.compile(r"\b(anti|counter)[- ]+(?=clockwise)"), r"\1"), (re.compile(r"\bright (?=now\b|away\b)"), ""))


def words(text: str) -> list[str]:
    """The words of a text in lower case, sorted: their order carries nothing here.

    Digits, signs and words with other letters than English has are left out.
    """
    text = text.lower()
    for pattern, replacement in _COMPOUNDS:
        text = pattern.sub(replacement, text)
    return sorted(word for word in _WORD.findall(text) if word.isascii())


def flags(text: str) -> frozenset[str]:
    """The flags that the words of a text set."""
    found = words(text)
    marked = {flag for flag, pattern in _COMPILED.items() if any(pattern.fullmatch(word) for word in found)}
    return frozenset(marked | {flag for word, flag, other in _UNLESS if word in found and other not in marked})
