"""What the core says, as a page says it: with the remedies of a page, in the language shown.

Errors, doubts, rules behind a class and outcomes of uploads are English sentences of the core, in
files and logs as well. A page finds each by its form here, and its translation in the catalogue.
"""

from __future__ import annotations

import re
from functools import lru_cache

from cucumbervision_greenhouse.backend.fruit_words import label_words
from cucumbervision_greenhouse.backend.language import (
    decimal_words,
    language,
    marked,
    ngettext,
)
from cucumbervision_greenhouse.backend.language import gettext as _

# Remedies of the core name options of commands; a reader of a page has the camera file and the
# page 'Settings' instead.
_ON_PAGES = (
    (r"measure it without --calibration", "choose no calibration in 'Settings'"),
    (
        r"say so with --aligned-to (color|depth)",
        r"say aligned_to: \1 in the camera file sent with it",
    ),
    (r"--depth-unit ([\d.e-]+) is", r"depth_unit_m: \1 in the camera file is"),
    (r"--depth-unit ([\d.e-]+(?: or [\d.e-]+)*)", r"depth_unit_m: \1 in the camera file"),
    (
        r"read such depth with --depth-along ray",
        "say depth_along: ray in the camera file sent with it",
    ),
    (r"leave out --depth-along and --aligned-to", "leave both out of the camera file"),
    (r"with --intrinsics FILE", "as an intrinsics file"),
    (r"give --intrinsics", "send one camera file alone"),
    (r"leave --input-size out|choose another --input-size", "choose the input size in 'Settings'"),
    (r"choose other --instances", "choose where fruit come from in 'Settings'"),
    (r"; --classes chooses among them", ""),
)


def said(error: object) -> str:
    """Return an error, doubt or rule of the core as a page says it, in the language shown.

    What is not known stays English.

    Examples
    --------
    >>> said("it was made for another camera; measure it without --calibration")
    "it was made for another camera; choose no calibration in 'Settings'"
    >>> said("is one step of depth really 1 mm? --depth-unit 0.0001 would explain it")
    'is one step of depth really 1 mm? depth_unit_m: 0.0001 in the camera file would explain it'
    """
    text = str(error)
    if len(text) > _LONGEST:
        return text
    for option, remedy in _ON_PAGES:
        text = re.sub(option, remedy, text)
    return text if language() == "en" else _translated(text, language())


_LONGEST = 2000  # characters: no sentence of the core, and reading it would take long
_JOINTS_AT_AN_END = 4  # a sentence has fewer; a name may have any number, in hundreds of ways


def _joints(text: str, joint: str) -> list[tuple[int, int]]:
    """Return where a text may be parted: the first and the last places of a joint."""
    spans = [match.span() for match in re.finditer(re.escape(joint), text)]
    return list(dict.fromkeys([*spans[:_JOINTS_AT_AN_END], *spans[-_JOINTS_AT_AN_END:]]))


@lru_cache(maxsize=2000)
def _translated(text: str, code: str) -> str:
    if (line := _line(text, code)) is not None:
        return line
    # A fault and its remedy; each may have a semicolon of its own.
    joints = _joints(text, "; ")
    for start, end in joints:
        if (line := _line(text[:start], code)) is not None:
            return f"{line}; {_translated(text[end:], code)}"
    for start, end in _joints(text, " ("):
        rule, source = text[:start], text[end:-1]
        if text.endswith(")") and (words := _line(rule, code)) is not None:
            return f"{words} ({_translated(source, code)})"
    for start, end in joints:
        if (remedy := _line(text[end:], code)) is not None:
            return f"{text[:start]}; {remedy}"
    return text


def _line(text: str, code: str) -> str | None:
    """Return a sentence that may follow the name of a file; None if it is not known."""
    if (words := _sentence(text, code)) is not None:
        return words
    for start, end in _joints(text, ": "):
        if (words := _sentence(text[end:], code)) is not None:
            source = text[:start]
            return f"{_sentence(source, code) or source}: {words}"
    return None


def _sentence(text: str, code: str) -> str | None:
    """Return a sentence of the table in a language; None if it is none of them."""
    for form, sentence in _forms():
        if (match := form.fullmatch(text)) is not None:
            parts = {name: _part(name, part, code) for name, part in match.groupdict().items()}
            if sentence == _COUNT:
                return ngettext(sentence, sentence, int(text.split()[0])).format(**parts)
            return _(sentence).format(**parts)
    return None


def _part(name: str, text: str, code: str) -> str:
    """Return what stands in a sentence's placeholder."""
    if name in ("classes", "steps", "unit"):
        parts = re.split("(, | or )", text)
        return "".join(label_words(part) if part.strip() else part for part in parts)
    if re.fullmatch(r"[+-]?\d+\.\d+", text):
        return decimal_words(text)
    known = _(text)
    return _translated(text, code) if known == text else known


@lru_cache(maxsize=1)
def _forms() -> list[tuple[re.Pattern[str], str]]:
    """Return the sentences with their forms; those with more words of their own come first."""
    forms = []
    for sentence in SENTENCES:
        parts = re.split(r"\{(\w+)\}", sentence)
        words = "".join(parts[::2])
        parts[1::2] = [f"(?P<{name}>{_PART.get(name, _ANY)})" for name in parts[1::2]]
        parts[::2] = map(re.escape, parts[::2])
        forms.append((-len(words), re.compile("".join(parts)), sentence))
    return [(form, sentence) for __, form, sentence in sorted(forms, key=lambda form: form[0])]


_ANY = r"(?:(?!\) \().)+?"  # a source in brackets is not part of a sentence
_PART = {
    **dict.fromkeys(("n", "count", "fruit", "number", "files"), r"\d+"),
    **dict.fromkeys(("low", "high"), r"[-+\de.]+"),
    "classes": r"[^(]+?",  # a source in brackets follows them
}

_COUNT = "{n} fruit"  # the only one with a plural

SENTENCES = (
    # Files and folders that were sent.
    marked("is not a file type we can read"),
    marked("send PNG, JPEG or TIFF pictures, .npy, JSON, or a zip of them"),
    marked("has no matching picture: a capture is a colour and a depth picture"),
    marked("send both, named alike but for the words color and depth, and an intrinsics.json"),
    marked("has no colour picture of a matching name"),
    marked("has no depth picture of a matching name"),
    marked("put it beside this one"),
    marked("a colour picture alone has no distances"),
    marked("name a colour picture with its depth picture, or a capture folder"),
    marked("is a recording, which is only read on the computer where it lies"),
    marked(
        "copy it to the computer that measures: `cucumbervision round add FILE` there adds "
        "its captures to the newest round"
    ),
    marked("holds no captures that can be recognised, but {kinds}"),
    marked("pack capture folders, BOP scenes, or colour and depth pictures with matching names"),
    marked(
        "give a folder with capture.json, a BOP scene (scene_camera.json), colour and depth "
        "pictures named alike but for the words color and depth, or a .bag or .db3"
        " recording"
    ),
    marked("the file is empty"),
    marked("copy it again"),
    marked("is not a readable file"),
    marked("is not a readable picture"),
    marked("is truncated or damaged"),
    marked("copy or export it again"),
    marked("correct or export it again"),
    marked("is damaged or of another form ({text})"),
    marked("is not readable text"),
    marked("is nested too deeply"),
    marked("has no {name}"),
    marked("cannot be read ({reason})"),
    marked("cannot be written ({reason})"),
    marked("cannot be kept ({reason})"),
    marked("uploads cannot be kept ({reason})"),
    marked("make room on the disk"),
    marked("free some space on the disk"),
    marked("check the disk and its permissions"),
    marked("check who may read it"),
    marked("check who may read and write it"),
    marked("check the path"),
    marked("choose another folder"),
    marked("close other programs"),
    marked("shorten the name"),
    marked("rename it"),
    marked("does not exist"),
    marked("there is not enough memory"),
    marked("close other programs, or use smaller pictures"),
    marked("this is a defect of the software: please report it with the file"),
    marked("has more than {size} MB of text"),
    marked("send a smaller file"),
    marked("is more than the {size} MB that are taken"),
    marked("{size} MB are more than the {limit} MB that are taken"),
    marked("send it in smaller parts"),
    marked("send it in smaller parts, or change the limit in 'Settings'"),
    marked("the disk has room for {size} MB"),
    marked("The computer cannot store more ({reason}): free some space on its disk"),
    marked("{files} files were sent, at most {limit} are taken at once"),
    marked("send them in smaller parts, or as a zip"),
    marked("is not a readable zip"),
    marked("pack or copy it again"),
    marked("pack the folder again"),
    marked("holds more than {files} files"),
    marked("a member's name leads out of the zip ({name})"),
    marked("pack the captures' folder again"),
    marked("nests more than {depth} folders"),
    marked("pack the captures' folder alone"),
    marked("its member {name} is a link or a device"),
    marked("pack the files themselves"),
    marked("its member {name} is locked or packed in an unusual way"),
    marked("pack it without a password, as a plain zip"),
    marked("its member {name} has more than {size} MB"),
    marked("its member {name} unpacks to more than {ratio} times its size"),
    marked("pack the files again; pictures never shrink that much"),
    marked("unpacks to more than is accepted"),
    marked("has two members of one name"),
    marked("is nested too deep in other zips"),
    marked("unpack it first"),
    marked("there is no such file"),
    marked("is larger than it was"),
    marked("this upload is gone"),
    marked("choose the files again"),
    marked("the request is damaged; reload the page"),
    # What became of an upload.
    marked("{words} (row {row}, {side}, {position} m)"),
    marked(
        "{words} (row {row}, {side}, {position} m; computer-made, so in the round 'Demonstration')"
    ),
    _COUNT,
    marked("ended the program each time it was measured"),
    marked("was deleted: undo that to have it back"),
    marked("was there already, and is measured again: its intrinsics or options changed"),
    marked("is in the round already"),
    marked("stop {number} is at {position} m of that row and side"),
    marked("a stop is at {position} m of that row and side"),
    marked("choose another position, or move or delete that stop first"),
    # Pictures, depth and cameras.
    marked("its levels are {kind}, whose range is unknown"),
    marked("save it with 8 or 16 bits a colour"),
    marked("the mask is {mask}, the picture {picture}"),
    marked("give a mask of the picture's size"),
    marked("has more than {n} million pixels"),
    marked("give a smaller picture"),
    marked("holds Python objects (pickle), which are never loaded"),
    marked("is truncated or no NumPy file"),
    marked("save the array as uint16 or float32 with numpy.save"),
    marked("has no array 'depth', only {names}"),
    marked("save it with numpy.savez(file, depth=...)"),
    marked("depth has no reading between {low} and {high} m: {what}"),
    marked("readings run from {low} to {high} m"),
    marked("every pixel is 0"),
    marked("check the depth stream and its unit, and capture again"),
    marked(
        "depth is {kind}, not one value a pixel; a colourised picture of depth has no distances"
    ),
    marked("depth has {bits} bits ({kind}), a picture to look at and no distances"),
    marked("give the 16-bit depth itself"),
    marked(
        "depth is declared in {declared}, but {outside} % of its readings then lie outside "
        "{low} to {high} m; in {unit} {inside} % lie inside"
    ),
    marked("declare the depth unit {unit}"),
    marked("no camera's depth has steps of {unit} m"),
    marked("correct the unit"),
    marked("is the Viewer's colourised picture of depth, which has no distances"),
    marked("depth is {depth}, colour {color}"),
    marked(
        "align depth to colour, so that both have one size; or, if depth has the colour "
        "camera's field of view in fewer pixels, say aligned_to: color in the camera file "
        "sent with it"
    ),
    marked("carries no camera intrinsics, without which pixels have no lengths"),
    marked("give the colour camera's as an intrinsics file"),
    marked("holds no intrinsics"),
    marked("give one JSON object with stream, fx, …"),
    marked("does not say which stream these intrinsics belong to"),
    marked(
        'add "stream": "color", or call the file color_intrinsics, if they are the colour '
        "camera's at that size (depth-stream intrinsics scale every length)"
    ),
    marked(
        "these are the {stream} stream's intrinsics (fx {fx} px), but the depth is aligned to"
        " colour{wrong}"
    ),
    marked(
        "give the colour stream's intrinsics; or, if the colour picture was aligned to depth,"
        " say aligned_to: depth in the camera file sent with it"
    ),
    marked("the intrinsics are for {camera}, the picture is {picture}"),
    marked("give the colour stream's intrinsics at {size}"),
    marked("does not say its size, and {point} px is not near the middle of a picture of {size}"),
    marked("give the intrinsics of this size of picture"),
    marked(
        "the principal point {point} px is the middle of a picture of about {size}, {factor} "
        "times as large as {picture}: lengths would come out about {percent} % wrong"
    ),
    marked("divide fx, fy, cx, cy by {factor}, or give the calibration of this size"),
    marked("the principal point {point} px is outside the picture of {size}"),
    marked("give cx and cy in pixels of this picture"),
    marked("the lens distortion {coefficients} cannot be undone in the picture's corners"),
    marked("give k1, k2, p1, p2, k3 of this camera"),
    marked("{names} hold different cameras, and no name tells which is {picture}'s"),
    marked("begin its name as the pictures' (cam1_intrinsics.json), or send one camera file alone"),
    marked("keep its block alone"),
    marked("has another camera model than pinhole with radtan"),
    marked("rectify the pictures, or calibrate with these"),
    marked("is no whole frame ({reason})"),
    marked("its frames are damaged"),
    marked("take it again"),
    marked("the process that measured it was killed twice"),
    marked("no RealSense camera is connected"),
    marked("plug a D4xx into a USB 3 port, or name a recording"),
    marked("no connected camera streams that size and rate"),
    marked("choose a size and rate of the camera, and check that it is at a USB 3 port"),
    marked("the camera is in use"),
    marked("close the other program that uses it"),
    marked("the camera failed ({reason})"),
    marked("plug it in again"),
    marked("plug the camera in again, at a USB 3 port"),
    marked("no frame with colour and depth for {seconds} s"),
    marked("the {setting} cannot be set"),
    marked("leave that setting out"),
    marked("no preset is called {name}"),
    marked("pyrealsense2 is not installed"),
    marked("pyrealsense2 cannot be loaded ({reason})"),
    marked("install the system package libusb-1.0-0 (libusb1 on Fedora)"),
    marked("the camera sends nothing"),
    marked("check its cable and try again"),
    marked("there is no picture of that moment any more"),
    marked("press again"),
    marked("nothing to replay"),
    marked("choose another replay"),
    marked("holds no captures"),
    marked("the recording is over"),
    marked("play a longer one"),
    marked("the recording stalls"),
    marked("is not a recording that can be played ({reason})"),
    marked("copy it again, or record it with RealSense Viewer"),
    marked("has no frame with both colour and depth"),
    marked("record both streams at one rate"),
    # Doubts about the data of a round.
    marked("what is behind them is a plane only if depth is the distance along each pixel's ray"),
    marked("say depth_along: ray in the camera file sent with it"),
    marked("{count} of {fruit} fruit: {fault}"),
    marked("nearer than 12 cm, where no camera reads"),
    marked("check the unit of depth (depth_unit_m: 0.001 in the camera file is 1 mm a step)"),
    marked("less than half of their pixels have depth"),
    marked("hold the camera at least 30 cm away"),
    marked("the depth of their middle lies behind that of their flanks"),
    marked("check that the depth picture holds distances, and not their inverse or relative depth"),
    marked("their outline has pieces with a gap between them that lies behind"),
    marked("give each fruit an outline of its own"),
    marked("their depth has coarse steps, as in a picture of 8 bits or in whole centimetres"),
    marked("give depth as the camera recorded it, with 16 bits in millimetres or finer"),
    marked("outline and depth do not lie together"),
    marked("check that depth is aligned to colour, and masks are of this picture"),
    marked("the intrinsics' principal point lies off the middle of the picture"),
    marked("check that they are of this size of picture"),
    marked("depth has fewer pixels than colour and was enlarged"),
    marked("record depth aligned to colour at its size"),
    marked("measured as fruit: {classes}"),
    marked("no fruit has a possible size (median {size} cm)"),
    marked("{count} of {fruit} fruit are too large (median {size} cm)"),
    marked("do the intrinsics belong to this camera's colour at this size?"),
    marked(
        "is one step of depth really 1 mm? depth_unit_m: {steps} in the camera file would "
        "explain it"
    ),
    # Outlines, stops, rounds and their changes.
    marked("no fruit was found there"),
    marked("no fruit was found there: the outline takes most of the picture"),
    marked("tap its middle or draw a closer box"),
    marked("that is fruit {number}, which is there already"),
    marked("tap the fruit itself, or delete one of the two"),
    marked("a mask has no pixel"),
    marked("leave it out"),
    marked("nothing to undo"),
    marked("see the log"),
    marked("delete a stop on the row map"),
    marked("this picture is not there any more"),
    marked("reload the page"),
    marked("this stop is still being measured"),
    marked("try again"),
    marked("a later action depends on action {number}"),
    marked("undo the later one first"),
    marked("it was changed again since"),
    marked("undo the later change first"),
    marked("somebody else has changed it meanwhile"),
    marked("look at it as it is now"),
    marked("no fruit was named"),
    marked("name at least one"),
    marked("{first} and {second} are not two fruit that can be linked so"),
    marked("merge two of one round, link growth between two rounds"),
    marked("fruit {key} is not in the store"),
    marked("stop {key} is not in the store"),
    marked("round {key} is not in the store"),
    marked("1 capture waits to be measured into it"),
    marked("{n} captures wait to be measured into it"),
    marked("delete it afterwards"),
    marked("the later round was walked no later, by the times of its captures"),
    marked("name the earlier one first"),
    marked("there is no round {key}"),
    marked("see the list of rounds"),
    marked("row '{row}' has {n} sides: {sides}"),
    marked("call the two sides of a row by two names"),
    marked("the pictures of this capture were not kept"),
    marked("measure the capture again"),
    marked("its content does not match its name"),
    marked("the file is damaged"),
    marked("the {what} '{name}' contains {sign}, which is no letter or sign"),
    marked("type it again; only letters, digits, signs and spaces"),
    marked("the {what} '{name}' has {n} characters, and {most} are taken"),
    marked("shorten it"),
    # Crops, lengths by hand and calibrations.
    marked("the lengths do not rise"),
    marked("give each class a longer limit"),
    marked("no class is ready to be picked"),
    marked("choose at least one"),
    marked("the crop '{name}' is saved by that name"),
    marked("give it a name with other letters or digits"),
    marked("look at its limits as they are now"),
    marked("the crop has no name"),
    marked("give it one with letters or digits"),
    marked("no crop profile is called {name}"),
    marked("not valid TOML ({reason})"),
    marked("correct that line"),
    marked("has no column {names}"),
    marked("line {number}: '{cell}' is no length"),
    marked("correct the file, or delete it and type the lengths again"),
    marked("write one line a length, and close every quote"),
    marked("line {number}: {length} cm is not a plausible length"),
    marked("give centimetres, between 1 and 100"),
    marked("give centimetres, such as 23.5 or 23,5"),
    marked(
        "the lengths are not in centimetres: their median is {ratio} times what was measured,"
        " about {words}"
    ),
    marked("there is nothing to report"),
    marked("measure at least one fruit first"),
    marked("calibration '{name}' was made for another camera: {different}"),
    marked("calibrate this camera, or choose no calibration in 'Settings'"),
    marked("capture '{name}' is of another camera than the first: {different}"),
    marked("calibrate each camera on its own"),
    marked("no method measured any of the fruit in the truth whole"),
    marked("measure with other masks or methods"),
    marked("no grid of {crossings} crossings in {captures} captures"),
    marked("show a flat square grid whose lines are 12 to 60 pixels apart"),
    marked("depth reads {scale} times the distance of the grid, which no depth scale is"),
    marked("check the spacing of the lines (in millimetres) and the intrinsics"),
    marked("these pictures were measured with a calibration, which changed their depth"),
    marked("choose no calibration, begin a round and take pictures of the grid again"),
    marked("this round"),
    marked("the limits"),
    marked("is not a calibration file"),
    marked("calibrate again with this software"),
    marked("the model {name} is not on this machine"),
    marked("the file is missing"),
    marked("this installation names no address of its source (Source in [project.urls])"),
    marked("whoever runs it owes you the source (AGPL-3.0, section 13)"),
    marked("its SHA-256 is not the registry's"),
    # Notes on lengths by hand.
    marked("Hand-measured lengths: {file}, {n} of them."),
    marked("No fruit was measured twice by hand, so the floor is not known."),
    marked(
        "Floor: one measurement by hand has a standard deviation of {size} mm ({percent} %), "
        "from {n} measurements of {fruit} fruit."
    ),
    marked(
        "No column 'specimen': each fruit of each capture counts as a fruit of its own. If "
        "some were captured several times, name them, or the intervals are too narrow."
    ),
    marked(
        "{n} fruit go on out of sight, or have a flag of wrong depth: they count as errors here, "
        "and a calibration leaves them out."
    ),
    marked("{n} fruit were not found at all and count as 100 % error."),
    marked("Columns not used: {names}."),
    marked("Some of these captures are simulated."),
    # Rules behind a class.
    marked("class {name}: {kind} length {length} cm is in [{low}, {high})"),
    marked("too short: {kind} length {length} cm is under {limit}"),
    marked("too long: {kind} length {length} cm is {limit} or more"),
    marked("undecided: {kind} length {low} to {high} cm: {classes}"),
    marked("undecided: {kind} length at least {length} cm: {reason}"),
    marked("undecided: {kind} length the length is uncertain"),
    marked(
        "refused: {kind} length {length} cm cannot be, {crop} is accepted from {low} to {high} cm"
    ),
    marked("measure again"),
    marked("at best class {name}, {shape}: inner arc {arc} mm for each 10 cm of chord"),
    marked("too light: about {mass} g, at least {limit} g required"),
    marked("not class {classes}: chord {length} cm, {weight} must be {limit} cm long"),
    marked("too thin: {width} mm, at least {limit} mm required"),
    marked("remark: {rule}"),
    marked("{weight} and more"),
    marked("{low} to {high} g"),
)
"""Forms of the sentences, each `{part}` any text or number."""
