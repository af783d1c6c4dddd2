/* One view in the words of a scan's document. */
#include "clients/cbct/view_json.h"

cJSON *view_json(const struct view *view)
{
	cJSON *json = cJSON_CreateObject();

	cJSON_AddItemToObject(json, "source_mm", cJSON_CreateDoubleArray(view->source, 3));
	cJSON_AddItemToObject(json, "pixel0_mm", cJSON_CreateDoubleArray(view->pixel0, 3));
	cJSON_AddItemToObject(json, "column_step_mm", cJSON_CreateDoubleArray(view->column_step, 3));
	cJSON_AddItemToObject(json, "row_step_mm", cJSON_CreateDoubleArray(view->row_step, 3));
	return json;
}
