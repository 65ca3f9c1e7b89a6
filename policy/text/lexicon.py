"""Words that decide what is meant, as flags: a sentence embedding alone barely tells left from right."""

from __future__ import annotations

import re

# Flag -> patterns that a whole word must match. Stems with the endings that English gives them; "tourne", "linksum" and
# other languages' words stay out.
_PATTERNS: dict[str, str] = {
    "left": r"left(ward|wards|hand|handed|most)?|port(side)?|(anti|counter)clockwise",
    "right": r"right(ward|wards|hand|handed|most)?|starboard|clockwise",
    "forward": r"forwards?|ahead|onwards?|straight|forth|front|advanc(e|es|ing)",
    "back": r"back(ward|wards|ing|s|pedal|pedalling|up)?|revers(e|es|ing)|retreat(s|ing)?|rearwards?|rear|behind",
    "both": r"both",
    "turn": r"turn(s|ing)?|rotat(e|es|ing|ion)|spin(s|ning)?|pivot(s|ing)?|swivel(s|ling|ing)?|twirl(s|ing)?|"
    r"yaw(s|ing)?|revolv(e|es|ing)|whirl(s|ing)?",
    "side-step": r"side(s|step|steps|stepping|ways?|ward|wards|long)?|straf(e|es|ing)|lateral(ly)?|crab(s|wise)?|"
    r"shuffl(e|es|ing)|slid(e|es|ing)",
    "diagonal": r"diagonal(s|ly)?|oblique(ly)?|slant(s|ed|ing|wise)?|aslant|corner",
    "arc": r"arc(s|ing)?|curv(e|es|ed|ing)|veer(s|ing)?|bend(s|ing)?|circl(e|es|ing)|circular|loop(s|ing)?|"
    r"swerv(e|es|ing)|swing(s|ing)?|bow|steer(s|ing)?",
    "slow": r"slow(er|ly|s|ing)?|creep(s|ing)?|crawl(s|ing)?|gent(le|ly)|careful(ly)?|cautious(ly)?|leisurely|"
    r"unhurried|inch(es|ing)?|amble|ambling|calm(ly)?|easy|sneak|tiptoe|gradual(ly)?",
    "fast": r"fast(er)?|quick(er|ly)?|rapid(ly)?|swift(ly)?|speed(s|ing|y|ily)?|hurr(y|ies|ying|ied)|run(s|ning)?|"
    r"jog(s|ging)?|rush(es|ing)?|brisk(ly)?|sprint(s|ing)?|hast(e|en|ily)|dash|race|racing",
    "stop": r"stop(s|ped|ping)?|stand(s|ing)?|halt(s|ed|ing)?|still|stay(s|ing)?|wait(s|ing)?|freez(e|es|ing)|"
    r"hold(s|ing)?|rest(s|ing)?|paus(e|es|ing)|remain(s|ing)?|idl(e|ing)|motionless|stationary|upright",
}
FLAGS: tuple[str, ...] = tuple(_PATTERNS)
_COMPILED = {flag: re.compile(pattern) for flag, pattern in _PATTERNS.items()}
_WORD = re.compile(r"[^\W\d_]+")
_OPPOSITE = re.compile(r"\b(anti|counter)[- ]+(?=clockwise)")


def words(text: str) -> list[str]:
    """The words of a text in lower case, sorted: their order carries nothing here. Digits and signs are left out."""
    return sorted(_WORD.findall(_OPPOSITE.sub(r"\1", text.lower())))


def flags(text: str) -> frozenset[str]:
    """The flags that the words of a text set."""
    found = words(text)
    return frozenset(flag for flag, pattern in _COMPILED.items() if any(pattern.fullmatch(word) for word in found))
