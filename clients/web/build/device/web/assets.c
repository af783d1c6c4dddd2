/* Made by build/device/web/npm/build.mjs: the page's files, inside of the daemon. */
#include "daemon/assets.h"

__asm__(".section .rodata\n"
	"asset_0: .incbin \"/work/main/clients/web/build/device/web/files/chunk-OOJM4CTU.js\"\n"
	"asset_0_gz: .incbin \"/work/main/clients/web/build/device/web/files/chunk-OOJM4CTU.js.gz\"\n"
	"asset_1: .incbin \"/work/main/clients/web/build/device/web/files/decode-4NFKZ2I7.js\"\n"
	"asset_1_gz: .incbin \"/work/main/clients/web/build/device/web/files/decode-4NFKZ2I7.js.gz\"\n"
	"asset_2: .incbin \"/work/main/clients/web/build/device/web/files/icon-BB856CAF.svg\"\n"
	"asset_2_gz: .incbin \"/work/main/clients/web/build/device/web/files/icon-BB856CAF.svg.gz\"\n"
	"asset_3: .incbin \"/work/main/clients/web/build/device/web/files/index.html\"\n"
	"asset_3_gz: .incbin \"/work/main/clients/web/build/device/web/files/index.html.gz\"\n"
	"asset_4: .incbin \"/work/main/clients/web/build/device/web/files/licences-772BB5BD.txt\"\n"
	"asset_4_gz: .incbin \"/work/main/clients/web/build/device/web/files/licences-772BB5BD.txt.gz\"\n"
	"asset_5: .incbin \"/work/main/clients/web/build/device/web/files/main-2JTEBOIB.js\"\n"
	"asset_5_gz: .incbin \"/work/main/clients/web/build/device/web/files/main-2JTEBOIB.js.gz\"\n"
	"asset_6: .incbin \"/work/main/clients/web/build/device/web/files/render-BS7BZK3E.js\"\n"
	"asset_6_gz: .incbin \"/work/main/clients/web/build/device/web/files/render-BS7BZK3E.js.gz\"\n"
	"asset_7: .incbin \"/work/main/clients/web/build/device/web/files/style-MSJKBEFE.css\"\n"
	"asset_7_gz: .incbin \"/work/main/clients/web/build/device/web/files/style-MSJKBEFE.css.gz\"\n"
	".previous\n");

extern const unsigned char asset_0[], asset_0_gz[];
extern const unsigned char asset_1[], asset_1_gz[];
extern const unsigned char asset_2[], asset_2_gz[];
extern const unsigned char asset_3[], asset_3_gz[];
extern const unsigned char asset_4[], asset_4_gz[];
extern const unsigned char asset_5[], asset_5_gz[];
extern const unsigned char asset_6[], asset_6_gz[];
extern const unsigned char asset_7[], asset_7_gz[];

const struct asset assets[] = {
    {"chunk-OOJM4CTU.js", "text/javascript; charset=utf-8", "9dbaaa1b267ebd74", asset_0, 638, asset_0_gz, 388},
    {"decode-4NFKZ2I7.js", "text/javascript; charset=utf-8", "d5d35cce4fa65fa7", asset_1, 8701, asset_1_gz, 4088},
    {"icon-BB856CAF.svg", "image/svg+xml", "bb856caf58155bc4", asset_2, 371, asset_2_gz, 243},
    {"", "text/html; charset=utf-8", "43499a0f7f587b95", asset_3, 1092, asset_3_gz, 601},
    {"licences-772BB5BD.txt", "text/plain; charset=utf-8", "772bb5bd97e3b80a", asset_4, 9400, asset_4_gz, 1750},
    {"main-2JTEBOIB.js", "text/javascript; charset=utf-8", "d5d50c619fa57ece", asset_5, 58721, asset_5_gz, 20609},
    {"render-BS7BZK3E.js", "text/javascript; charset=utf-8", "c4ea7f8fd132cf01", asset_6, 892485, asset_6_gz, 327910},
    {"style-MSJKBEFE.css", "text/css; charset=utf-8", "d6f3fb1d8ed70cae", asset_7, 15999, asset_7_gz, 4456},
    {0},
};
