"""A way to a PostgreSQL server that loses answers: listens on TO/.s.PGSQL.5432 and passes everything on to
FROM/.s.PGSQL.5432. Where the file TO/lose holds a word, the next commit of a session is lost with its connection, and
the file with it:

    before    the server does not hear of it
    after     the server has done it, and nobody hears the answer

As long as the file TO/refuse is there, no connection is made.

usage: lossy.py FROM TO
"""
import asyncio
import os
import sys
from pathlib import Path

source, folder = sys.argv[1], Path(sys.argv[2])


def wanted() -> str:
    try:
        word = (folder / "lose").read_text().strip()
        (folder / "lose").unlink()
        return word
    except FileNotFoundError:
        return ""


async def serve(client_in: asyncio.StreamReader, client_out: asyncio.StreamWriter) -> None:
    if (folder / "refuse").exists():
        client_out.close()
        return
    server_in, server_out = await asyncio.open_unix_connection(f"{source}/.s.PGSQL.5432")
    lost = asyncio.Event()

    async def up() -> None:
        while data := await client_in.read(1 << 16):
            word = wanted() if b"; COMMIT" in data else ""
            if word:
                lost.set()
            if word != "before":
                server_out.write(data)
                await server_out.drain()
            if word:
                await asyncio.sleep(0.3)  # the server has done it by then
                break

    async def down() -> None:
        while data := await server_in.read(1 << 16):
            if lost.is_set():
                continue
            client_out.write(data)
            await client_out.drain()

    tasks = [asyncio.create_task(up()), asyncio.create_task(down())]
    await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    for task in tasks:
        task.cancel()
    for writer in (client_out, server_out):
        writer.close()


async def main() -> None:
    server = await asyncio.start_unix_server(serve, path=f"{folder}/.s.PGSQL.5432")
    print("ready", flush=True)
    async with server:
        await server.serve_forever()


os.umask(0)
asyncio.run(main())
