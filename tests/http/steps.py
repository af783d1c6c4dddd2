#!/usr/bin/python3
"""A department's system that is told of performed procedure steps (PS3.4 annex F), by the library Odil.

Usage: steps.py PORT LOG    listens on PORT; LOG gets a line of JSON for each message that it takes: [NAME, UID, {tag: value}].
                            What table F.7.2-1 asks for and is not there is refused.
"""
import json
import sys

import odil

STEP = "1.2.840.10008.3.1.2.3.3"
SUCCESS, PROCESSING_FAILURE, NO_SUCH, DUPLICATE, MISSING = 0x0000, 0x0110, 0x0112, 0x0111, 0x0120
CREATED_WITH = """00400270 00100010 00100020 00100030 00100040 00081120 00400253 00400241 00400242 00400243 00400244 00400245 00400252
00400254 00400255 00081032 00400250 00400251 00080060 00200010 00400260 00400340""".split()
FILLED = "00400253 00400241 00400244 00400245 00080060".split()
OF_SERIES = "00081050 00181030 00081070 0020000e 0008103e 00080054 00081140 00400220".split()


def values(data_set):
    """As {tag: text or list of such}."""
    found = {}
    for tag, element in data_set.items():
        name = f"{tag.group:04x}{tag.element:04x}"
        if element.is_data_set():
            found[name] = [values(one) for one in element.as_data_set()]
        elif element.empty():
            found[name] = ""
        else:
            found[name] = "\\".join(value.decode() for value in element.as_string())
    return found


class System:
    def __init__(self, log):
        self.log, self.steps = log, {}

    def note(self, name, uid, told):
        with open(self.log, "a", encoding="utf-8") as file:
            print(json.dumps([name, uid, told], ensure_ascii=False), file=file)

    def create(self, request):
        uid, told = request.get_affected_sop_instance_uid(), values(request.get_data_set())
        if uid in self.steps:
            return DUPLICATE
        if [tag for tag in CREATED_WITH if tag not in told] or told["00400252"] != "IN PROGRESS" or told["00400340"]:
            return MISSING
        if not told["00400270"][0]["0020000d"] or not all(told[tag] for tag in FILLED):
            return MISSING
        self.note("create", uid, told)
        self.steps[uid] = told["00400252"]
        return SUCCESS

    def set(self, request):
        uid, told = request.get_requested_sop_instance_uid(), values(request.get_data_set())
        if uid not in self.steps:
            return NO_SUCH
        if self.steps[uid] != "IN PROGRESS":
            return PROCESSING_FAILURE
        series = told.get("00400340", [])
        if told["00400252"] not in ("COMPLETED", "DISCONTINUED") or not told["00400250"] or not told["00400251"]:
            return MISSING
        if told["00400252"] == "COMPLETED" and not series or [tag for one in series for tag in OF_SERIES if tag not in one]:
            return MISSING
        self.note("set", uid, told)
        self.steps[uid] = told["00400252"]
        return SUCCESS


def serve(port, system):
    while True:
        association = odil.Association()
        association.receive_association("v4", port)
        create, change, echo = odil.NCreateSCP(association), odil.NSetSCP(association), odil.EchoSCP(association)
        create.set_callback(system.create)
        change.set_callback(system.set)
        echo.set_callback(lambda request: SUCCESS)
        dispatcher = odil.SCPDispatcher(association)
        dispatcher.set_ncreate_scp(create)
        dispatcher.set_nset_scp(change)
        dispatcher.set_echo_scp(echo)
        try:
            while True:
                dispatcher.dispatch()
        except (odil.AssociationReleased, odil.AssociationAborted):
            pass
        except odil.Exception as error:
            print(error, flush=True)


serve(int(sys.argv[1]), System(sys.argv[2]))
