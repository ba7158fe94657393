-- An index as the first schema (m001_initial) wrote it: `sqlite3 index.sqlite .dump`. Do not edit.
BEGIN TRANSACTION;
CREATE TABLE migrations (number INTEGER PRIMARY KEY, name TEXT UNIQUE NOT NULL, applied_utc TEXT NOT NULL);
INSERT INTO migrations VALUES(1,'m001_initial','2026-11-20T10:00:00+00:00');
CREATE TABLE scenes (
            scene_id       TEXT PRIMARY KEY,
            revision       TEXT NOT NULL,
            schema_version TEXT NOT NULL,
            created_utc    TEXT NOT NULL,
            source_file    TEXT NOT NULL,
            source_sha256  TEXT NOT NULL,
            n_objects      INTEGER NOT NULL
        );
INSERT INTO scenes VALUES('kitchen','0123456789abcdef','simrecon.scene/1','2026-11-20T10:00:00+00:00','kitchen.mp4','ab',4);
INSERT INTO scenes VALUES('scene0007','fedcba9876543210','simrecon.scene/1','2026-11-20T11:00:00+00:00','a.mp4','cd',9);
COMMIT;
