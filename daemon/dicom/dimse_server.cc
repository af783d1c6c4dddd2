// DIMSE as a service class provider, of one association: dimse.h.
#include <dcmtk/config/osconfig.h>

#include <dcmtk/dcmdata/dctk.h>
#include <dcmtk/dcmnet/scp.h>
#include <dcmtk/oflog/oflog.h>

#include <cerrno>
#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/dicom/dimse_promise.h"

bool promise_read(DcmDataset *answer, struct dimse_promise *ret_promise)
{
	DcmSequenceOfItems *kept = nullptr, *refused = nullptr;
	struct dimse_promise promise = {};
	OFString transaction;
	Uint16 reason = 0;

	answer->findAndGetOFString(DCM_TransactionUID, transaction);
	if (transaction.empty() || transaction.size() >= sizeof(promise.transaction))
		return false;
	memcpy(promise.transaction, transaction.c_str(), transaction.size() + 1);
	answer->findAndGetSequence(DCM_ReferencedSOPSequence, kept);
	answer->findAndGetSequence(DCM_FailedSOPSequence, refused);
	promise.kept = kept != nullptr ? (int)kept->card() : 0;
	promise.refused = refused != nullptr ? (int)refused->card() : 0;
	if (promise.refused > 0)
		refused->getItem(0)->findAndGetUint16(DCM_FailureReason, reason);
	promise.reason = reason;
	*ret_promise = promise;
	return true;
}

namespace
{

// Runs of projections; volumes are not what this takes.
const char *const stored_classes[] = {UID_XRayAngiographicImageStorage, UID_EnhancedXAImageStorage,
				      UID_XRayRadiofluoroscopicImageStorage};
// Those that `cbct import` reads.
const char *const stored_syntaxes[] = {UID_LittleEndianExplicitTransferSyntax, UID_LittleEndianImplicitTransferSyntax,
				       UID_RLELosslessTransferSyntax, UID_JPEGProcess14SV1TransferSyntax,
				       UID_JPEGLSLosslessTransferSyntax};
enum { OBJECTS_MOST = 20000 };

class Server : public DcmSCP
{
      public:
	const struct dimse_serving *serving = nullptr;

      protected:
	OFBool checkCalledAETitleAccepted(const OFString &called) override
	{
		return called == serving->title;
	}

	OFBool checkCallingAETitleAccepted(const OFString &calling) override
	{
		caller = calling;
		for (const char *const *caller = serving->callers; *caller != nullptr; caller++)
			if (calling == *caller)
				return OFTrue;
		return OFFalse;
	}

	void notifyAssociationAcknowledge() override
	{
		begun = true;
		serving->accepted(serving->context);
	}

	void refuseAssociation(const DcmRefuseReasonType reason) override
	{
		tell_refusal(reason == DCMSCP_CALLED_AE_TITLE_NOT_RECOGNIZED ? "it calls another title than ours"
			     : reason == DCMSCP_CALLING_AE_TITLE_NOT_RECOGNIZED
				 ? "it is none of the peers that may call"
			     : reason == DCMSCP_NO_PRESENTATION_CONTEXTS ? "it asks for nothing that is served here"
									 : "its request is none that is understood");
		DcmSCP::refuseAssociation(reason);
	}

	OFBool stopAfterCurrentAssociation() override
	{
		return OFTrue;
	}
	OFBool stopAfterConnectionTimeout() override
	{
		return OFTrue;
	}

	OFCondition handleIncomingCommand(T_DIMSE_Message *message, const DcmPresentationContextInfo &info) override
	{
		if (message->CommandField == DIMSE_C_STORE_RQ)
			return store(message->msg.CStoreRQ, info.presentationContextID);
		if (message->CommandField == DIMSE_N_EVENT_REPORT_RQ)
			return report(message->msg.NEventReportRQ, info.presentationContextID);
		return DcmSCP::handleIncomingCommand(message, info);
	}

      public:
	bool begun = false; // or refused, and told

	void tell_refusal(const char *why)
	{
		char title[17] = "";

		for (size_t i = 0; i < caller.size() && i < sizeof(title) - 1; i++) {
			title[i] = (char)(caller[i] >= 0x20 && caller[i] <= 0x7e ? caller[i] : '?');
			title[i + 1] = '\0';
		}
		begun = true;
		serving->refused(serving->context, title, why);
	}

      private:
	int stored = 0;
	OFString caller;

	OFCondition store(T_DIMSE_C_StoreRQ &request, T_ASC_PresentationContextID presentation)
	{
		char part[1100];

		if (stored >= OBJECTS_MOST)
			return abortAssociation();
		snprintf(part, sizeof(part), "%s/part-%d", serving->directory, (int)getpid());
		OFCondition condition = receiveSTORERequest(request, presentation, part);
		// A message that broke off leaves no association.
		const Uint16 status = condition.good() ? keep(part) : (Uint16)STATUS_STORE_Refused_OutOfResources;
		unlink(part);
		stored += status == STATUS_Success;
		return condition.good() ? sendSTOREResponse(presentation, request, status) : condition;
	}

	// Gives an object its name; nothing of it is trusted but what this checks.
	Uint16 keep(const char *part)
	{
		OFString run, series, instance;
		char folder[1300], path[1500];
		DcmFileFormat file;
		Sint32 frames = 1, number = 0;

		if (file.loadFileUntilTag(part, EXS_Unknown, EGL_noChange, 1024, ERM_autoDetect, DCM_PixelData).bad())
			return STATUS_STORE_Error_CannotUnderstand;
		DcmDataset *dataset = file.getDataset();
		dataset->findAndGetOFString(DCM_SeriesInstanceUID, series);
		dataset->findAndGetOFString(DCM_SOPInstanceUID, instance);
		dataset->findAndGetSint32(DCM_NumberOfFrames, frames);
		dataset->findAndGetSint32(DCM_InstanceNumber, number);
		run = frames > 1 ? instance : series;
		if (!is_uid(run) || !is_uid(instance))
			return STATUS_STORE_Error_CannotUnderstand;
		snprintf(folder, sizeof(folder), "%s/%s", serving->directory, run.c_str());
		snprintf(path, sizeof(path), "%s/%08d-%s.dcm", folder, number > 0 && number < 100000000 ? number : 0,
			 instance.c_str());
		if ((mkdir(folder, 0700) != 0 && errno != EEXIST) || !synced(part) || rename(part, path) != 0 ||
		    !synced(folder) || !synced(serving->directory))
			return STATUS_STORE_Refused_OutOfResources;
		return STATUS_Success;
	}

	static bool is_uid(const OFString &text)
	{
		return !text.empty() && text.size() <= 64 && text[0] != '.' &&
		       text.find_first_not_of("0123456789.") == OFString_npos;
	}

	// DcmSCP's own reply leaves the class out, which some archives do not take.
	OFCondition report(T_DIMSE_N_EventReportRQ &request, T_ASC_PresentationContextID presentation)
	{
		T_DIMSE_Message reply = {};
		T_DIMSE_N_EventReportRSP &answer = reply.msg.NEventReportRSP;
		DcmDataset *dataset = nullptr;
		struct dimse_promise promise;
		OFCondition condition;

		if (request.DataSetType != DIMSE_DATASET_NULL)
			condition = receiveDIMSEDataset(&presentation, &dataset);
		if (condition.good() && dataset != nullptr && promise_read(dataset, &promise))
			serving->promised(serving->context, &promise);
		delete dataset;
		reply.CommandField = DIMSE_N_EVENT_REPORT_RSP;
		answer.MessageIDBeingRespondedTo = request.MessageID;
		answer.DimseStatus = STATUS_Success;
		answer.DataSetType = DIMSE_DATASET_NULL;
		answer.EventTypeID = request.EventTypeID;
		OFStandard::strlcpy(answer.AffectedSOPClassUID, request.AffectedSOPClassUID,
				    sizeof(answer.AffectedSOPClassUID));
		OFStandard::strlcpy(answer.AffectedSOPInstanceUID, request.AffectedSOPInstanceUID,
				    sizeof(answer.AffectedSOPInstanceUID));
		answer.opts = O_NEVENTREPORT_AFFECTEDSOPCLASSUID | O_NEVENTREPORT_AFFECTEDSOPINSTANCEUID |
			      O_NEVENTREPORT_EVENTTYPEID;
		return condition.good() ? sendDIMSEMessage(presentation, &reply, nullptr) : condition;
	}

	static bool synced(const char *path)
	{
		const int file = open(path, O_RDONLY | O_CLOEXEC);
		const bool done = file >= 0 && fsync(file) == 0;

		if (file >= 0)
			close(file);
		return done;
	}
};

} // namespace

int dimse_serve(const struct dimse_serving *serving, int connection, struct error *err)
{
	OFList<OFString> plain, syntaxes;
	Server server;

	OFLog::configure(OFLogger::OFF_LOG_LEVEL);
	plain.push_back(UID_LittleEndianExplicitTransferSyntax);
	plain.push_back(UID_LittleEndianImplicitTransferSyntax);
	for (const char *syntax : stored_syntaxes)
		syntaxes.push_back(syntax);
	// DCMTK takes this connection in place of one that it would accept.
	dcmExternalSocketHandle.set(connection);
	server.serving = serving;
	server.setAETitle(serving->title);
	server.setMaxReceivePDULength(131072);
	server.setDIMSEBlockingMode(DIMSE_NONBLOCKING);
	server.setDIMSETimeout((Uint32)serving->seconds);
	server.setACSETimeout((Uint32)serving->seconds);
	server.setConnectionBlockingMode(DUL_NOBLOCK);
	server.setConnectionTimeout((Uint32)serving->seconds);
	server.setHostLookupEnabled(OFFalse);
	server.addPresentationContext(UID_VerificationSOPClass, plain);
	// The archive is the provider of this class, also where it opens the association.
	server.addPresentationContext(UID_StorageCommitmentPushModelSOPClass, plain, ASC_SC_ROLE_SCU);
	for (const char *stored : stored_classes)
		if (serving->directory != nullptr)
			server.addPresentationContext(stored, syntaxes);
	OFCondition condition = server.listen();
	if (!server.begun)
		server.tell_refusal("what it sends is no request for an association");
	if (condition.bad() && condition != NET_EC_StopAfterAssociation &&
	    condition != NET_EC_StopAfterConnectionTimeout)
		return error_set(err, ERR_IO, "an association: %.160s", condition.text());
	return 0;
}
